"""Refinement of coarse matches in 5x5 windows of the fine maps (Sun et al. 2021, section 3.4)."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.networks.grids import as_grid
from mkpc_kaggle.matchers.networks.layers import Assignment, Linear, linear

# Pixels of the input per cell of the two maps.
COARSE_STRIDE = 8
FINE_STRIDE = 2
SIDE = 5  # of a window, in fine cells
CENTRE = SIDE * SIDE // 2  # the index of a window's middle cell, row by row
REACH = SIDE // 2 * FINE_STRIDE  # pixels per unit of the offset, half a window


class SemiDenseMatches(NamedTuple):
    """M matches of a pair, in order of the coarse cell of image 0.

    ``points0``, ``points1``: (M, 2) float32 (x, y) in pixels of the network's input, in a frame
    whose origin is the corner of the image: the centre of the top-left pixel is (0.5, 0.5). Points
    of image 0 lie on the grid of coarse cells; points of image 1 are refined by up to 4 pixels.
    ``coarse``: cells, as row-major indices in the cell's own map, and confidences.
    """

    coarse: Assignment
    points0: Tensor
    points1: Tensor


class FinePreprocess(nn.Module):
    """Windows merged with the coarse features of their cells."""

    def __init__(self, coarse: int, fine: int) -> None:
        super().__init__()
        self.down_proj = Linear(coarse, fine)
        self.merge_feat = Linear(2 * fine, fine)

    def forward(self, windows: Tensor, context: Tensor) -> Tensor:
        """Map windows (M, 25, fine) and coarse features (M, coarse) to (M, 25, fine)."""
        # A linear map of the concatenation [window, context] is a sum of two maps. The context's is
        # computed once per match, not 25 times.
        of_window, of_context = self.merge_feat.weight.chunk(2, dim=1)
        added = linear(self.down_proj(context), of_context, self.merge_feat.bias)  # (M, fine)
        return linear(windows, of_window).add_(added[:, None])


def cell_points(cells: Tensor, width: int) -> Tensor:
    """Return the top-left corners of cells (M,) in a map of ``width`` columns.

    Corners are (M, 2) float32, (x, y) in pixels.
    """
    columns_and_rows = torch.stack([cells % width, cells // width], dim=1)
    return columns_and_rows.float() * COARSE_STRIDE


def cut_windows(fine: Tensor, cells: Tensor) -> Tensor:
    """Cut windows (M, 25, C) float32 around coarse cells (M,) from a fine map (1, C, Hf, Wf).

    A window is centred on its coarse cell's top-left fine cell, row-major, and zero outside the
    map.
    """
    grid = as_grid(fine)  # (1, Hf, Wf, C)
    width, channels = grid.shape[2:]
    step = COARSE_STRIDE // FINE_STRIDE
    coarse_width = width // step
    around = torch.arange(SIDE, device=fine.device) - SIDE // 2
    rows = (cells // coarse_width * step)[:, None, None] + around[:, None]  # (M, 5, 1)
    columns = (cells % coarse_width * step)[:, None, None] + around  # (M, 1, 5)
    # Centres are at multiples of the step, so windows exceed the map at the top and left only.
    index = rows.clamp(min=0) * width + columns.clamp(min=0)  # (M, 5, 5)
    # Gathering avoids the unfolded map of all windows, which is 25 / 16 of the fine map.
    table = grid.reshape(-1, channels)
    read = table.index_select(0, index.flatten()).float()
    windows = read.view(-1, SIDE * SIDE, channels)
    outside = (rows < 0) | (columns < 0)  # (M, 5, 5)
    return windows.masked_fill_(outside.flatten(1)[..., None], 0.0)


def expected_offset(windows0: Tensor, windows1: Tensor) -> Tensor:
    """Return the mean offset (M, 2) float32, x and y in -1..1, from M pairs of windows (M, 25, C).

    The centre of window 0 is compared with each cell of window 1; a softmax gives the offset's
    distribution.
    """
    centres = windows0[:, CENTRE, :, None]  # (M, C, 1)
    logits = (windows1 @ centres)[..., 0] / windows0.shape[2] ** 0.5  # (M, 25)
    axis = torch.linspace(-1.0, 1.0, SIDE, device=logits.device)
    x = axis.repeat(SIDE)
    y = axis.repeat_interleave(SIDE)
    offsets = torch.stack([x, y], dim=1)  # (25, 2)
    mean: Tensor = logits.softmax(dim=1) @ offsets
    return mean
