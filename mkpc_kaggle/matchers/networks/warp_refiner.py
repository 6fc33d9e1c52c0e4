"""The warp refiners of DKM and RoMa, and their local correlation.

Source: Edstedt et al. 2023, "DKM", section 3.3.

Normalised coordinates are (x, y) in [-1, 1]; +-1 are the outer edges of an image. In an image of w
x h the centre of pixel (column j, row i) is ((2 j + 1) / w - 1, (2 i + 1) / h - 1).
"""

from math import ceil
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.networks.grids import as_grid, as_map, pointwise
from mkpc_kaggle.matchers.networks.layers import ExactConv2d, depthwise_block, resize

HIDDEN_BLOCKS = 8


class WarpRefinerShape(NamedTuple):
    """Channels of a refiner's maps: features of either image, embedded displacement, hidden maps.

    ``radius``: of the local correlation in pixels; without one the refiner does not correlate.
    """

    features: int
    embedding: int
    radius: int | None
    hidden: int


# By stride. Hidden maps are as wide as the input, 2 features + embedding + (2 radius + 1)^2, except
# DKM's at stride 1.
SHAPES = {
    16: WarpRefinerShape(512, 128, 7, 1377),
    8: WarpRefinerShape(512, 64, 3, 1137),
    4: WarpRefinerShape(256, 32, 2, 569),
    2: WarpRefinerShape(64, 16, None, 144),
    1: WarpRefinerShape(3, 6, None, 24),
}


class WarpEstimate(NamedTuple):
    """An estimate of a warp, float32.

    ``flow`` (B, 2, h, w): each pixel's position in the other image, normalised and unclamped.
    ``certainty`` (B, 1, h, w): logits.
    """

    flow: Tensor
    certainty: Tensor

    def resized(self, size: torch.Size) -> "WarpEstimate":
        return WarpEstimate(resize(self.flow, size), resize(self.certainty, size))


class WarpRefiner(nn.Module):
    """Depthwise 5x5 and 1x1 convolutions in turns, of both images' features aligned by the flow."""

    def __init__(self, shape: WarpRefinerShape) -> None:
        super().__init__()
        self.radius = shape.radius
        window = 0 if shape.radius is None else (2 * shape.radius + 1) ** 2
        self.block1 = depthwise_block(
            2 * shape.features + shape.embedding + window, shape.hidden
        )
        blocks = (depthwise_block(shape.hidden, shape.hidden) for _ in range(HIDDEN_BLOCKS))
        self.hidden_blocks = nn.Sequential(*blocks)
        self.out_conv = ExactConv2d(shape.hidden, 3, 1)
        self.disp_emb = ExactConv2d(2, shape.embedding, 1)

    def forward(
        self, query: Tensor, support: Tensor, flow: Tensor, stretch: float = 1
    ) -> Tensor:
        """Return corrections (B, 3, h, w) of a flow (B, 2, h, w).

        Features are (B, C, h, w) of the query and (B, C, h', w') of the support. Displacements are
        multiplied by ``stretch`` before they are embedded. In DKM channel 0 corrects the
        certainty's logit; 1 and 2 correct x and y, in eighths of a query pixel at this stride (see
        :func:`refined`).
        """
        x = self._look(query, support, flow, stretch)  # (B, inputs, h, w)
        for depthwise, norm, _, mix in (self.block1, *self.hidden_blocks):
            # A single variable, so that at most two maps are in memory at a time.
            x = torch.relu_(norm(depthwise(x)))
            x = as_map(pointwise(mix, as_grid(x)))
        corrections: Tensor = self.out_conv(x.float())
        return corrections

    def _look(self, query: Tensor, support: Tensor, flow: Tensor, stretch: float) -> Tensor:
        """Return the refiner's input (B, inputs, h, w) in the order of its channels."""
        seen = functional.grid_sample(
            support.float(),
            as_grid(flow),
            mode="bilinear",
            padding_mode="zeros",
            align_corners=False,
        )
        displacement = flow - identity_map(flow)
        parts = [query, seen, self.disp_emb(stretch * displacement)]
        if self.radius is not None:
            parts.append(local_correlation(query, support, flow, self.radius))
        precision = self.block1.get_parameter("0.weight").dtype
        looks = torch.cat([part.to(precision) for part in parts], dim=1)
        return looks.contiguous(memory_format=torch.channels_last)


def refined(
    estimate: WarpEstimate, corrections: Tensor, stride: int, full: torch.Size
) -> WarpEstimate:
    """Apply a refiner's corrections; ``full`` (H, W) is the query image's size in this pass."""
    height, width = full
    # An eighth of a pixel at this stride: a pixel is 2 stride / width wide.
    unit = corrections.new_tensor([stride / (4 * width), stride / (4 * height)])
    flow = estimate.flow + corrections[:, 1:] * unit[:, None, None]
    return WarpEstimate(flow, estimate.certainty + corrections[:, :1])


def local_correlation(query: Tensor, support: Tensor, flow: Tensor, radius: int) -> Tensor:
    """Correlate each query pixel's features with a window of the support's around its target.

    The query is (B, C, h, w), the support (B, C, h', w') and the flow (B, 2, h, w). Return dot
    products over sqrt(C), (B, (2 radius + 1)^2, h, w) float32, windows row by row. Window steps are
    one pixel of the query: 2 / w and 2 / h. The support is zero outside, bilinear between pixels.

    The product with a bilinear sample is the bilinear sample of products. So products are computed
    with all pixels that a window covers, and then interpolated.
    """
    size = query.shape[2:]
    height, width = size
    height1, width1 = support.shape[2:]
    flows = as_grid(flow).reshape(-1, 2)  # (P, 2), P = B h w
    targets = (
        (flows + 1) * flow.new_tensor([width1, height1]) - 1
    ) / 2  # pixels of the support
    # In pixels of the support, a step is the ratio of the two sizes.
    columns, along_x = taps(targets[:, 0], width1, width1 / width, radius)
    rows, along_y = taps(targets[:, 1], height1, height1 / height, radius)
    image = torch.arange(len(query), device=flow.device).repeat_interleave(
        size.numel()
    )  # (P,)
    lines = (image[:, None] * height1 + rows) * width1  # (P, Ky): first pixels of the lines
    index = lines[:, :, None] + columns[:, None]  # (P, Ky, Kx)

    queries = as_grid(query.float()).flatten(0, 2)  # (P, C)
    keys = as_grid(support.float()).flatten(0, 2)  # (B h' w', C)
    products = _products(queries, keys, index.flatten(1)).view_as(index)
    window = along_y @ products @ along_x.mT  # (P, 2 radius + 1, 2 radius + 1)
    scaled = window.mul_(query.shape[1] ** -0.5)
    return as_map(scaled.view(len(query), *size, -1))


def taps(targets: Tensor, length: int, step: float, radius: int) -> tuple[Tensor, Tensor]:
    """Return the pixels (P, K) int64 that windows cover on one axis, and their weights.

    ``targets`` (P,) are the windows' centres. Weights (P, 2 radius + 1, K) interpolate linearly at
    each step of a window. Pixels outside the axis get zero.
    """
    steps = torch.arange(-radius, radius + 1, device=targets.device) * step
    first = (targets - radius * step).floor()
    # A window of length 2 radius step starts within a pixel and ends within another: two more.
    reach = torch.arange(ceil(2 * radius * step) + 2, device=targets.device)
    positions = (targets - first)[:, None] + steps  # (P, 2 radius + 1), from the first pixel
    distances = (positions[:, :, None] - reach).abs_()  # (P, 2 radius + 1, K)
    weights = distances.neg_().add_(1).clamp_(min=0)
    pixels = first[:, None].long() + reach
    outside = (pixels < 0) | (pixels >= length)
    # Any valid index will do for a pixel outside, as its weight is zero.
    return pixels.clamp_(0, length - 1), weights.masked_fill_(outside[:, None], 0)


def _products(queries: Tensor, keys: Tensor, index: Tensor) -> Tensor:
    """Return the dot products (P, K) of queries (P, C) with the keys (N, C) at ``index`` (P, K)."""
    neighbours = index.shape[1]
    channels = keys.shape[1]
    # The gathered keys of a block fit a processor's cache; a GPU needs few large blocks.
    floats = 2**26 if keys.is_cuda else 2**20
    at_once = max(1, floats // (neighbours * channels))
    products = queries.new_empty(index.shape)
    blocks = zip(
        torch.split(queries, at_once),
        torch.split(index, at_once),
        torch.split(products, at_once),  # views, which the products fill
        strict=True,
    )
    for some, positions, out in blocks:
        gathered = keys.index_select(0, positions.flatten()).view(-1, neighbours, channels)
        # A row times a matrix; MKL takes ten times as long for the reverse.
        rows = some[:, None]
        torch.bmm(rows, gathered.transpose(1, 2), out=out[:, None])
    return products


def identity_map(like: Tensor) -> Tensor:
    """Return (1, 2, h, w): the normalised pixel centres, x and y, of a map (..., h, w)."""
    height, width = like.shape[-2:]
    x = torch.linspace(1 / width - 1, 1 - 1 / width, width, device=like.device)
    y = torch.linspace(1 / height - 1, 1 - 1 / height, height, device=like.device)
    xs = x.expand(height, width)
    ys = y[:, None].expand(height, width)
    return torch.stack([xs, ys])[None]
