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
    """Map (B, C, h, w) to (B h w, C) float32; a view where the maps are float32 and channels last."""
    return as_grid(maps).flatten(0, 2).float()


def corners(positions: Tensor, image: Tensor, size: torch.Size) -> tuple[Tensor, Tensor]:
    """Return the pixels (Q, 4) int64 around positions (Q, 2) in maps ``image`` (Q,), and their
    weights (Q, 4).

    Pixels outside the map, of ``size`` (h, w), have the weight 0 and the index of another pixel.
    """
    height, width = size
    x, y = positions.unbind(1)
    first = image * (height * width)
    rows = [(first + row * width, weight) for row, weight in neighbours(y, height)]
    columns = neighbours(x, width)
    index = torch.stack([row + column for row, _ in rows for column, _ in columns], dim=1)
    return index, torch.stack(
        [along_y * along_x for _, along_y in rows for _, along_x in columns], dim=1
    )


def neighbours(positions: Tensor, length: int) -> list[tuple[Tensor, Tensor]]:
    """Return the pixels before and after each position (Q,) on one axis, int64, with their weights.

    A NaN position gets a NaN weight and a valid pixel, since a GPU fails on an index out of range.
    """
    before = positions.floor()
    share = positions - before
    return [
        (
            pixel.clamp(0, length - 1).nan_to_num(0).long(),
            weight.masked_fill((pixel < 0) | (pixel >= length), 0),
        )
        for pixel, weight in ((before, 1 - share), (before + 1, share))
    ]


def weighted_rows(table: Tensor, index: Tensor, weights: Tensor) -> Tensor:
    """Sum weights (Q, K) times the rows ``index`` (Q, K) of a table (P, C) over K: (Q, C)."""
    return functional.embedding_bag(index, table, mode="sum", per_sample_weights=weights)


def sampled(maps: Tensor, positions: Tensor, image: Tensor) -> Tensor:
    """Sample maps (B, C, h, w) at positions (Q, 2) of the maps ``image`` (Q,): (Q, C) float32, zero
    outside.
    """
    return weighted_rows(table_of(maps), *corners(positions, image, maps.shape[2:]))


class DeformableConv2d(nn.Conv2d):
    """A 3x3 convolution whose nine taps are moved by ``offset_conv`` at each pixel."""

    def __init__(self, channels: int, out_channels: int) -> None:
        super().__init__(channels, out_channels, KERNEL, padding=1, bias=False)
        self.offset_conv = ExactConv2d(channels, 2 * KERNEL**2, KERNEL, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, h, w) to (B, out_channels, h, w), like ``x``."""
        batch, _, height, width = x.shape
        reach = max(height, width) / 4
        # (B, h, w, 18): y, x by tap
        offsets = as_grid(self.offset_conv(x.float())).clamp(-reach, reach)
        rows, columns = (torch.arange(n, device=x.device) for n in (height, width))
        # (9, 2): x, y
        taps = torch.cartesian_prod(*2 * [torch.arange(KERNEL, device=x.device) - 1]).flip(1)
        # (h, w, 1, 2)
        pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=2)[:, :, None]
        # (B, h, w, 9, 2)
        positions = offsets.view(batch, height, width, -1, 2).flip(4) + (pixels + taps)
        image = torch.arange(batch, device=x.device).repeat_interleave(height * width * KERNEL**2)
        # (B, h, w, 9 C)
        seen = sampled(x, positions.flatten(0, 3), image).view(batch, height, width, -1)
        weight = self.weight.permute(0, 2, 3, 1).flatten(1)  # (out, 9 C)
        return as_map(linear(seen, weight, self.bias)).to(x.dtype)
