"""ASpanFormer (Chen et al., "Detector-Free Image Matching with Adaptive Span Transformer", 2022)."""

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.networks.aspan_transformer import AspanTransformer, Side
from mkpc_kaggle.matchers.networks.fine_matching import COARSE_STRIDE
from mkpc_kaggle.matchers.networks.grids import as_grid
from mkpc_kaggle.matchers.networks.linear_attention import Masks
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY, sine_positions
from mkpc_kaggle.matchers.networks.resnet_fpn import TOP
from mkpc_kaggle.matchers.networks.semi_dense import SemiDenseNetwork

POOLING = (4, 4)  # rows and columns of the coarse map that are a cell of the global level


class MatchingTemperature(nn.Module):
    """The learned factor of the similarity."""

    def __init__(self) -> None:
        super().__init__()
        self.temperature = nn.Parameter(torch.tensor(10.0))


class AspanFormer(SemiDenseNetwork[AspanTransformer]):
    """Sides are multiples of 32; the two images may differ in size.

    ``train_size``: (height, width) whose extent the positions of every image are stretched to. The defaults are
    those published for outdoor images of any size. Checkpoints also hold ``*.sample_offset``, which the published
    network ignores: leave them out.
    """

    multiple = 32

    def __init__(self, threshold: float = 0.2, border: int = 2, train_size: tuple[int, int] = (832, 832)) -> None:
        super().__init__(AspanTransformer(), threshold, border)
        self.train_size = train_size
        self.coarse_matching = MatchingTemperature()
        self.eval().requires_grad_(False)

    @property
    def similarity_scale(self) -> Tensor:
        return self.coarse_matching.temperature / TOP

    def transform(self, coarse0: Tensor, coarse1: Tensor, masks: Masks | None = None) -> tuple[Tensor, Tensor]:
        mask0, mask1 = masks or (None, None)
        grid0, grid1 = self.loftr_coarse(self.side(coarse0, mask0), self.side(coarse1, mask1))
        return grid0, grid1

    def side(self, coarse: Tensor, mask: Tensor | None) -> Side:
        """What the transformer is given of an image: its coarse map (N, 256, h, w) with positions added."""
        grid = as_grid(coarse)
        height, width = grid.shape[1:3]
        scale = self.position_scale(height, width)
        positions = sine_positions(height, width, FIXED_DECAY, scale, grid.device)[None]  # (1, h, w, 256)
        visual = (grid + positions).contiguous()
        return Side(visual, visual.new_empty(0), self.loftr_coarse.project(positions), POOLING, mask)

    def position_scale(self, height: int, width: int) -> tuple[float, float]:
        """The factors (y, x) that stretch the positions in a coarse map."""
        train_height, train_width = self.train_size
        return train_height / (COARSE_STRIDE * height), train_width / (COARSE_STRIDE * width)
