"""Bilinear samples of tables of pixels, and a deformable convolution on them (Dai et al. 2017).

A table (P, C) holds the pixels of B maps of one size, map by map and row by row: a channels-last
batch as rows. Positions are (x, y) in pixels of their map.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.networks.grids import as_grid, as_map
from mkpc_kaggle.matchers.networks.layers import ExactConv2d, linear

KERNEL = 3


def table_of(maps: Tensor) -> Tensor:
    """Map (B, C, h, w) to (B h w, C) float32; a view of maps in float32 and channels last."""
    return as_grid(maps).flatten(0, 2).float()


def corners(positions: Tensor, image: Tensor, size: torch.Size) -> tuple[Tensor, Tensor]:
    """Return the four pixels (Q, 4) int64 around each position, and their weights (Q, 4).

    Positions (Q, 2) are in the maps ``image`` (Q,), of ``size`` (h, w). Pixels outside a map have
    the weight 0 and the index of another pixel.
    """
    height, width = size
    x, y = positions.unbind(1)
    first = image * (height * width)  # (Q,): the table's row of the map's first pixel
    index: list[Tensor] = []
    weights: list[Tensor] = []
    for row, along_y in neighbours(y, height):
        line = first + row * width
        for column, along_x in neighbours(x, width):
            index.append(line + column)
            weights.append(along_y * along_x)
    return torch.stack(index, dim=1), torch.stack(weights, dim=1)


def neighbours(positions: Tensor, length: int) -> list[tuple[Tensor, Tensor]]:
    """Return the pixels before and after each position (Q,) on one axis, int64, with their weights.

    A NaN position gets a NaN weight and a valid pixel, since a GPU fails on an index out of range.
    """
    before = positions.floor()
    share = positions - before
    found = []
    for pixel, weight in ((before, 1 - share), (before + 1, share)):
        outside = (pixel < 0) | (pixel >= length)
        # The comparisons are false for NaN, whose weight thus stays NaN: it is reported later.
        index = pixel.clamp(0, length - 1).nan_to_num(0).long()
        found.append((index, weight.masked_fill(outside, 0)))
    return found


def weighted_rows(table: Tensor, index: Tensor, weights: Tensor) -> Tensor:
    """Sum weights (Q, K) times the rows ``index`` (Q, K) of a table (P, C) over K: (Q, C)."""
    # One fused operator: the gathered rows (Q, K, C) are never stored.
    return functional.embedding_bag(index, table, mode="sum", per_sample_weights=weights)


def sampled(maps: Tensor, positions: Tensor, image: Tensor) -> Tensor:
    """Sample maps (B, C, h, w) at positions (Q, 2) of the maps ``image`` (Q,).

    Return (Q, C) float32, zero outside.
    """
    index, weights = corners(positions, image, maps.shape[2:])
    return weighted_rows(table_of(maps), index, weights)


class DeformableConv2d(nn.Conv2d):
    """A 3x3 convolution whose nine taps are moved by ``offset_conv`` at each pixel."""

    def __init__(self, channels: int, out_channels: int) -> None:
        super().__init__(channels, out_channels, KERNEL, padding=1, bias=False)
        # Two offsets for each tap. They are positions, so the layer keeps float32.
        self.offset_conv = ExactConv2d(channels, 2 * KERNEL**2, KERNEL, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, h, w) to (B, out_channels, h, w), like ``x``."""
        batch, _, height, width = x.shape
        # As trained, a tap moves by at most a quarter of the longer side.
        reach = max(height, width) / 4
        moves = as_grid(self.offset_conv(x.float())).clamp(-reach, reach)  # (B, h, w, 18)
        offsets = moves.view(batch, height, width, -1, 2).flip(4)  # y, x by tap -> x, y

        steps = torch.arange(KERNEL, device=x.device) - 1
        taps = torch.cartesian_prod(steps, steps).flip(1)  # (9, 2): x, y; row by row
        columns = torch.arange(width, device=x.device)
        rows = torch.arange(height, device=x.device)
        pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=2)  # (h, w, 2)
        # The integers are added before the offsets: their sum is exact.
        positions = offsets + (pixels[:, :, None] + taps)  # (B, h, w, 9, 2)

        # The convolution is a linear map of the nine samples of each pixel.
        image = torch.arange(batch, device=x.device).repeat_interleave(
            height * width * KERNEL**2
        )
        seen = sampled(x, positions.flatten(0, 3), image)  # (B h w 9, C)
        seen = seen.view(batch, height, width, -1)  # (B, h, w, 9 C)
        weight = self.weight.permute(0, 2, 3, 1).flatten(
            1
        )  # (out, 9 C): tap by tap, like samples
        return as_map(linear(seen, weight, self.bias)).to(x.dtype)
