"""Attention to keys around the target of a predicted flow, over a span that grows with its doubt.

Source: Chen et al., "ASpanFormer: Detector-Free Image Matching with Adaptive Span Transformer",
2022, section 3. A "cell" here is a 2x2 block of queries, which share 8 x 8 samples of the key map.
"""

import torch
from torch import Tensor
from torch.nn import functional

from mkpc_kaggle.matchers.networks.grids import (
    as_grid,
    as_map,
    mask_valid,
    mean_pool,
    to_2x2_blocks,
)

RADIUS = 5.0  # of a span, in standard deviations of the flow
SIDE = 8  # samples on each axis
# A cell's 64 samples of keys and values take 128 KiB: 32 MiB on a CPU, 1 GiB on a GPU.
CELLS_AT_ONCE = {"cpu": 256, "cuda": 8192}
MASKED = -1e8  # a finite logit: attention is uniform if all keys are masked


def adaptive_span(flow: Tensor, factor: int) -> Tensor:
    """Map a flow (N, h, w, 4) to samples (N, P, 64, 2) for the P cells of a level.

    ``factor``: how the level is pooled. A flow is the target (x, y), in coarse cells of the other
    image, and two log-variances. Samples cover two radii, with a step of at least one; x varies
    slowest. As published, centres are in units of the level, but steps are not. The origin is the
    key map's corner: a sample (x, y) reads around index (x - 0.5, y - 0.5).
    """
    deviation = torch.exp(flow[..., 2:] / 2) * RADIUS
    # The minimum is taken before pooling, as published.
    steps = (2 * deviation / SIDE).clamp(min=1.0)
    centres = flow[..., :2] / factor
    # A cell has 2 x 2 queries of the level, that is 2 factor x 2 factor coarse cells.
    pooled = mean_pool(torch.cat([centres, steps], dim=-1), 2 * factor)
    cells = pooled.flatten(1, 2)[:, :, None]  # (N, P, 1, 4)

    axis = torch.arange(SIDE, dtype=cells.dtype, device=cells.device)
    axis -= (SIDE - 1) / 2
    pattern = torch.cartesian_prod(axis, axis)  # (64, 2): -3.5 to 3.5 steps on each axis
    return cells[..., :2] + pattern * cells[..., 2:]


def sample_usable(
    samples: Tensor, mask: Tensor, key_size: tuple[int, int], factor: int
) -> Tensor:
    """Return (N, P, 64) bool: whether the mask of the *query* image is valid at the samples.

    The key image's mask would be right, but the networks were published with this oversight.
    Coordinates are relative to the key map (h, w); ``mask`` is (N, h, w) at the coarse level.
    """
    valid = mask_valid(mask, factor).float()[:, None]  # (N, 1, h / factor, w / factor)
    # Samples outside the map read 0, so with masks they are excluded, too.
    read = read_samples(valid, samples, key_size, mode="nearest")
    return read[:, 0] == 1


def read_samples(
    maps: Tensor, samples: Tensor, key_size: tuple[int, int], mode: str = "bilinear"
) -> Tensor:
    """Read maps (N, C, h, w) at samples (N, P, 64, 2); zero outside. Return (N, C, P, 64)."""
    size = samples.new_tensor([key_size[1], key_size[0]])
    normalised = samples / (size / 2) - 1  # -1 and 1 are the edges of the key map
    return functional.grid_sample(maps, normalised, mode=mode, align_corners=False)


def span_attention(
    q: Tensor, k: Tensor, v: Tensor, samples: Tensor, heads: int, usable: Tensor | None = None
) -> Tensor:
    """Attend from queries (N, h, w, C) to keys and values (N, h_key, w_key, C) at samples.

    Samples (N, h w / 4, 64, 2) are shared by the 2x2 queries of a cell. Return messages (N, h, w,
    C). A sample outside the key map has a zero key and value, and counts unless ``usable`` excludes
    it. Messages ordered by cell, four queries each, are read as rows of the map without reordering:
    the published networks were trained with this permutation within each two rows.
    """
    key_size = (k.shape[1], k.shape[2])
    # One map, so that keys and values are read together.
    both = torch.cat([k, v], dim=-1)  # (N, h_key, w_key, 2 C)
    maps = as_map(both).to(samples.dtype)
    cells = to_2x2_blocks(q) * (q.shape[3] // heads) ** -0.5  # (N, P, 4, C)
    messages = []
    at_once = CELLS_AT_ONCE.get(q.device.type, 256)
    for start in range(0, cells.shape[1], at_once):
        part = slice(start, start + at_once)
        queries = cells[:, part]
        read = as_grid(read_samples(maps, samples[:, part], key_size))  # (N, p, 64, 2 C)
        read = read.to(q.dtype)
        excluded = None if usable is None else ~usable[:, part].flatten(0, 1)
        found = _attend_cells(queries.flatten(0, 1), read.flatten(0, 1), heads, excluded)
        messages.append(found.view_as(queries))
    # Read as a map without undoing the order of cells: see above.
    return torch.cat(messages, dim=1).view_as(q)


def _attend_cells(
    queries: Tensor, read: Tensor, heads: int, excluded: Tensor | None
) -> Tensor:
    """Return messages (p, 4, C) to scaled queries from samples (p, 64, 2 C).

    Samples marked in ``excluded`` (p, 64) send none.
    """
    all_keys, all_values = read.chunk(2, dim=-1)
    keys = all_keys.chunk(heads, dim=-1)
    values = all_values.chunk(heads, dim=-1)
    found = []
    # Head by head: batched products of all heads would first copy the samples.
    by_head = queries.chunk(heads, dim=-1)
    for query, key, value in zip(by_head, keys, values, strict=True):
        logits = query @ key.transpose(1, 2)  # (p, 4, 64)
        if excluded is not None:
            logits.masked_fill_(excluded[:, None], MASKED)
        found.append(logits.softmax(dim=-1) @ value)
    return torch.cat(found, dim=-1)
