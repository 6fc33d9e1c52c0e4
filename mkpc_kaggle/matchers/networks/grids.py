"""What the matchers' transformers do with token grids, (..., h, w, C) with the channels last.

A grid is a view of a channels-last feature map, so that converting copies nothing.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.networks.layers import linear

Layer = nn.Linear | nn.Conv1d | nn.Conv2d


def as_map(grid: Tensor) -> Tensor:
    """(N, h, w, C) -> (N, C, h, w), channels last in memory."""
    return grid.permute(0, 3, 1, 2)


def as_grid(feature_map: Tensor) -> Tensor:
    """(N, C, h, w) -> (N, h, w, C); a view, and contiguous where the map was channels last."""
    return feature_map.permute(0, 2, 3, 1)


def mean_pool(grid: Tensor, factor: int | tuple[int, int]) -> Tensor:
    """Means of ``factor`` (rows, columns) blocks; incomplete ones at the right and bottom are dropped."""
    return grid if factor == 1 else as_grid(functional.avg_pool2d(as_map(grid), factor))


def to_2x2_blocks(grid: Tensor) -> Tensor:
    """(..., h, w, E) -> (..., h/2 * w/2, 4, E): 2x2 cells row by row, and row by row within each."""
    *lead, h, w, width = grid.shape
    cells = grid.reshape(*lead, h // 2, 2, w // 2, 2, width).transpose(-4, -3)  # (..., h/2, w/2, 2, 2, E)
    return cells.reshape(*lead, h * w // 4, 4, width)


def from_2x2_blocks(cells: Tensor, h: int, w: int) -> Tensor:
    """(..., h/2 * w/2, 4, E) -> (..., h, w, E): undoes :func:`to_2x2_blocks`."""
    *lead, _, _, width = cells.shape
    rows = cells.reshape(*lead, h // 2, w // 2, 2, 2, width).transpose(-4, -3)  # (..., h/2, 2, w/2, 2, E)
    return rows.reshape(*lead, h, w, width)


def pointwise(layer: nn.Conv1d | nn.Conv2d, x: Tensor) -> Tensor:
    """A convolution of kernel 1 on (..., C_in) -> (..., C_out)."""
    return linear(x, layer.weight.flatten(1), layer.bias)


class Perceptron(nn.Module):
    """Two layers without biases and a ReLU between them, with their names in an ``nn.Sequential``.

    The first is pointwise; so is the second, unless it is a 3x3 convolution of the grid.
    """

    def __init__(self, first: Layer, second: Layer) -> None:
        super().__init__()
        self.add_module("0", first)
        self.add_module("2", second)

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) -> (..., C_out)."""
        first, second = self.get_parameter("0.weight"), self.get_parameter("2.weight")
        hidden = functional.relu_(linear(x.to(first.dtype), first.flatten(1)))
        if second.shape[2:] == (3, 3):
            return as_grid(functional.conv2d(as_map(hidden), second, padding=1)).to(x.dtype)
        return linear(hidden, second.flatten(1)).to(x.dtype)


def mask_valid(mask: Tensor, factor: int | tuple[int, int]) -> Tensor:
    """(N, h, w) bool -> the same pooled: a block is valid only if all of its cells are."""
    return functional.max_pool2d((~mask).float()[:, None], factor)[:, 0] == 0


def softmax_attention(logits: Tensor, values: Tensor) -> Tensor:
    """(..., L, S) and (..., S, D) -> (..., L, D)."""
    return torch.softmax(logits, dim=-1) @ values
