"""Attention to keys around the target of a predicted flow, spaced by the uncertainty of the flow.

Source: Chen et al., "ASpanFormer: Detector-Free Image Matching with Adaptive Span Transformer", 2022, section 3.
"Cells" here are 2x2 blocks of queries; each block shares 8 x 8 samples of the key map.
"""

import torch
from torch import Tensor
from torch.nn import functional

from mkpc_kaggle.matchers.networks.grids import mask_valid, mean_pool, to_2x2_blocks

RADIUS = 5.0  # of a span, in deviations of the flow
SIDE = 8  # samples on each axis
SAMPLES = SIDE * SIDE
CELLS_AT_ONCE = {"cpu": 256, "cuda": 8192}  # a cell's samples take 128 KiB and must fit a CPU's cache
MASKED = -1e8  # a finite logit: attention is uniform if all keys are masked


def adaptive_span(flow: Tensor, factor: int) -> Tensor:
    """Map a flow (N, h, w, 4) to samples (N, P, 64, 2) of its P cells at the level that pools by ``factor``.

    The flow is the target (x, y) in coarse cells of the other image and its log-variances. The samples cover
    two radii, with a step of at least one; x varies slowest. As published, centres are in units of the level but
    steps are not. A sample at (x, y) reads around index (x - 0.5, y - 0.5): the origin is the key map's corner.
    """
    deviation = torch.exp(flow[..., 2:] / 2) * RADIUS
    steps = (2 * deviation / SIDE).clamp(min=1.0)
    pooled = mean_pool(torch.cat([flow[..., :2] / factor, steps], dim=-1), 2 * factor).flatten(1, 2)  # (N, P, 4)
    axis = torch.arange(SIDE, dtype=pooled.dtype, device=pooled.device) - (SIDE - 1) / 2
    return pooled[:, :, None, :2] + torch.cartesian_prod(axis, axis) * pooled[:, :, None, 2:]


def sample_usable(samples: Tensor, mask: Tensor, key_size: tuple[int, int], factor: int) -> Tensor:
    """Return (N, P, 64) bool: whether the mask of the *query* image is valid at the samples.

    The mask should be the key image's, but the networks were published with this oversight.
    Coordinates are relative to the key map (h, w); ``mask`` is (N, h, w) at the coarse level.
    """
    valid = mask_valid(mask, factor).float()[:, None]
    size = samples.new_tensor([key_size[1], key_size[0]])
    read = functional.grid_sample(valid, samples / (size / 2) - 1, mode="nearest", align_corners=False)
    return read[:, 0] == 1


def span_attention(
    q: Tensor, k: Tensor, v: Tensor, samples: Tensor, heads: int, usable: Tensor | None = None
) -> Tensor:
    """Map queries (N, h, w, C), keys, values (N, h_key, w_key, C), samples (N, h w / 4, 64, 2) to (N, h, w, C).

    Samples outside the key map have a zero key and value, but still count unless ``usable`` excludes them. The
    messages are ordered by cell, four queries each, and read as rows of the map without reordering: the
    published networks were trained with this permutation within each two rows.
    """
    table = torch.cat([k, v], dim=-1)  # (N, h_key, w_key, 2 C)
    image = torch.arange(len(q), device=q.device).repeat_interleave(samples[0, ..., 0].numel())
    index, weight = corners(samples.flatten(0, 2) - 0.5, image, table.shape[1:3])  # (N P 64, 4)
    cells = to_2x2_blocks(q).flatten(0, 1) * (q.shape[3] // heads) ** -0.5  # (N P, 4, C)
    rows = table.flatten(0, 2)
    messages = []
    at_once = CELLS_AT_ONCE.get(q.device.type, 256)
    for start in range(0, len(cells), at_once):
        part, taps = slice(start, start + at_once), slice(start * SAMPLES, (start + at_once) * SAMPLES)
        read = weighted_rows(rows, index[taps], weight[taps])  # (p 64, 2 C)
        out = None if usable is None else ~usable.flatten(0, 1)[part]
        messages.append(_attend_cells(cells[part], read.view(-1, SAMPLES, read.shape[1]), heads, out))
    return torch.cat(messages).view_as(q)


def _attend_cells(queries: Tensor, read: Tensor, heads: int, excluded: Tensor | None) -> Tensor:
    """Map scaled queries (p, 4, C), samples (p, 64, 2 C) of keys and values, ``excluded`` (p, 64) to (p, 4, C)."""
    keys, values = (half.chunk(heads, dim=-1) for half in read.chunk(2, dim=-1))
    found = []
    # Head by head: batched products of all heads would first copy the samples.
    for query, key, value in zip(queries.chunk(heads, dim=-1), keys, values, strict=True):
        logits = query @ key.transpose(1, 2)  # (p, 4, 64)
        if excluded is not None:
            logits.masked_fill_(excluded[:, None], MASKED)
        found.append(logits.softmax(dim=-1) @ value)
    return torch.cat(found, dim=-1)


def corners(positions: Tensor, image: Tensor, size: torch.Size) -> tuple[Tensor, Tensor]:
    """Return the pixels (Q, 4) int64 around positions (x, y), (Q, 2), in maps ``image`` (Q,), and their bilinear
    weights (Q, 4).

    Pixels are rows of a table of all maps, map by map and row by row. Pixels outside the map, of ``size`` (h, w),
    have the weight 0 and the index of another pixel.
    """
    height, width = size
    x, y = positions.unbind(1)
    first = image * (height * width)
    rows = [(first + row * width, weight) for row, weight in neighbours(y, height)]
    columns = neighbours(x, width)
    index = torch.stack([row + column for row, _ in rows for column, _ in columns], dim=1)
    return index, torch.stack([along_y * along_x for _, along_y in rows for _, along_x in columns], dim=1)


def neighbours(positions: Tensor, length: int) -> list[tuple[Tensor, Tensor]]:
    """Return the pixels before and after each position (Q,) on one axis, int64, with their weights.

    A NaN position gets a NaN weight and a valid pixel, since a GPU fails on an index out of range.
    """
    before = positions.floor()
    share = positions - before
    return [
        (pixel.clamp(0, length - 1).nan_to_num(0).long(), weight.masked_fill((pixel < 0) | (pixel >= length), 0))
        for pixel, weight in ((before, 1 - share), (before + 1, share))
    ]


def weighted_rows(table: Tensor, index: Tensor, weights: Tensor) -> Tensor:
    """Sum weights (Q, K) times the rows ``index`` (Q, K) of a table (P, C) over K: (Q, C)."""
    return functional.embedding_bag(index, table, mode="sum", per_sample_weights=weights)
