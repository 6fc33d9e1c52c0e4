"""Operations of the matchers' transformers on token grids, (..., h, w, C) with the channels last.

A grid is a view of a channels-last feature map, so conversions copy nothing.
"""

from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.networks.layers import linear

Layer = nn.Linear | nn.Conv1d | nn.Conv2d


def as_map(grid: Tensor) -> Tensor:
    """Map (N, h, w, C) to (N, C, h, w), channels last in memory."""
    return grid.permute(0, 3, 1, 2)


def as_grid(feature_map: Tensor) -> Tensor:
    """Map (N, C, h, w) to (N, h, w, C); a view, contiguous if the map was channels last."""
    return feature_map.permute(0, 2, 3, 1)


def mean_pool(grid: Tensor, factor: int | tuple[int, int]) -> Tensor:
    """Average blocks of ``factor`` (rows, columns); drop incomplete ones at right and bottom."""
    if factor == 1:
        return grid
    return as_grid(functional.avg_pool2d(as_map(grid), factor))


def to_2x2_blocks(grid: Tensor) -> Tensor:
    """Map (..., h, w, E) to (..., h/2 * w/2, 4, E): blocks of 2x2 cells, row by row.

    The four cells of a block are row by row, too.
    """
    *lead, h, w, width = grid.shape
    split = grid.reshape(*lead, h // 2, 2, w // 2, 2, width)
    blocks = split.transpose(-4, -3)  # (..., h/2, w/2, 2, 2, E)
    return blocks.reshape(*lead, h * w // 4, 4, width)


def from_2x2_blocks(cells: Tensor, h: int, w: int) -> Tensor:
    """Map (..., h/2 * w/2, 4, E) to (..., h, w, E): undo :func:`to_2x2_blocks`."""
    *lead, _, _, width = cells.shape
    blocks = cells.reshape(*lead, h // 2, w // 2, 2, 2, width)
    rows = blocks.transpose(-4, -3)  # (..., h/2, 2, w/2, 2, E)
    return rows.reshape(*lead, h, w, width)


def pointwise(layer: nn.Conv1d | nn.Conv2d, x: Tensor) -> Tensor:
    """Apply a convolution of kernel 1: map (..., C_in) to (..., C_out)."""
    return linear(x, layer.weight.flatten(1), layer.bias)


class Perceptron(nn.Module):
    """Two layers without biases, a ReLU between them, named as in an ``nn.Sequential``.

    The first layer is pointwise; the second is pointwise or a 3x3 convolution of the grid.
    """

    def __init__(self, first: Layer, second: Layer) -> None:
        super().__init__()
        # The checkpoints' names; "1" is the ReLU, which has no parameters.
        self.add_module("0", first)
        self.add_module("2", second)

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., C) to (..., C_out)."""
        # Checkpoints store pointwise layers as (out, in), (out, in, 1) or (out, in, 1, 1). All of
        # them are matrices here.
        first = self.get_parameter("0.weight")
        second = self.get_parameter("2.weight")
        hidden = functional.relu_(linear(x.to(first.dtype), first.flatten(1)))
        if second.shape[2:] == (3, 3):
            mixed = functional.conv2d(as_map(hidden), second, padding=1)
            return as_grid(mixed).to(x.dtype)
        return linear(hidden, second.flatten(1)).to(x.dtype)


def mask_valid(mask: Tensor, factor: int | tuple[int, int]) -> Tensor:
    """Pool (N, h, w) bool: a block is valid only if all of its cells are valid."""
    # PyTorch pools no booleans: a block is invalid if its maximum of "is padding" is 1.
    padding = (~mask).float()[:, None]
    return functional.max_pool2d(padding, factor)[:, 0] == 0
