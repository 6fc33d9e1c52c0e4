"""ASpanFormer (Chen et al., "Detector-Free Image Matching with Adaptive Span Transformer", 2022)."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.networks.aspan_transformer import AspanTransformer, Factor, Side
from mkpc_kaggle.matchers.networks.fine_matching import COARSE_STRIDE
from mkpc_kaggle.matchers.networks.grids import as_grid
from mkpc_kaggle.matchers.networks.linear_attention import Masks
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY, sine_positions
from mkpc_kaggle.matchers.networks.resnet_fpn import TOP
from mkpc_kaggle.matchers.networks.semi_dense import SemiDenseNetwork

POOLING = 4  # of the coarse map, for the global level


@dataclass(frozen=True)
class AspanFormerConfig:
    """As published for outdoor images of any size.

    ``train_size``: (height, width) whose extent the positions of every image are stretched to;
    ``position_scale``: (y, x) instead of that, the same for all images. ``coarsest``: (rows, columns) that
    the global level pools to; None pools by four. The published evaluations set both: on MegaDepth
    (832 / 1152, 832 / 1152) and (36, 36), on ScanNet (1, 1), (15, 20) and no border.
    """

    threshold: float = 0.2
    border: int = 2
    radius: float = 5.0
    train_size: tuple[int, int] = (832, 832)
    position_scale: tuple[float, float] | None = None
    coarsest: tuple[int, int] | None = None


class MatchingTemperature(nn.Module):
    """The learned factor of the similarity."""

    def __init__(self) -> None:
        super().__init__()
        self.temperature = nn.Parameter(torch.tensor(10.0))


class AspanFormer(SemiDenseNetwork[AspanTransformer]):
    """Sides are multiples of 32; the two images may differ in size.

    Checkpoints also hold ``*.sample_offset``, which the published network ignores: leave them out.
    """

    multiple = 32

    def __init__(self, config: AspanFormerConfig | None = None) -> None:
        config = config or AspanFormerConfig()
        transformer = AspanTransformer(config.radius)
        super().__init__(transformer, config.threshold, config.border)
        self.config = config
        self.coarse_matching = MatchingTemperature()
        self.eval().requires_grad_(False)

    @property
    def similarity_scale(self) -> Tensor:
        return self.coarse_matching.temperature / TOP

    def transform(self, coarse0: Tensor, coarse1: Tensor, masks: Masks | None = None) -> tuple[Tensor, Tensor]:
        mask0, mask1 = masks or (None, None)
        grid0, grid1 = self.loftr_coarse(self._side(coarse0, mask0), self._side(coarse1, mask1))
        return grid0, grid1

    def _side(self, coarse: Tensor, mask: Tensor | None) -> Side:
        grid = as_grid(coarse)
        height, width = grid.shape[1:3]
        train_height, train_width = self.config.train_size
        scale = self.config.position_scale or (
            train_height / (COARSE_STRIDE * height),
            train_width / (COARSE_STRIDE * width),
        )
        positions = sine_positions(height, width, FIXED_DECAY, scale, grid.device)[None]  # (1, h, w, 256)
        projected = self.loftr_coarse.project(positions)
        visual = (grid + positions).contiguous()
        return Side(
            visual, visual.new_empty(0), projected, pooling_factor(height, width, self.config.coarsest), mask
        )


def pooling_factor(height: int, width: int, coarsest: tuple[int, int] | None) -> Factor:
    """Of a coarse map, for the global level; ValueError where it does not divide the map."""
    factor = (POOLING, POOLING) if coarsest is None else (height // coarsest[0], width // coarsest[1])
    if 0 in factor or height % factor[0] or width % factor[1]:
        raise ValueError(f"a coarse map of {height} x {width} cannot be pooled by {factor}")
    return factor
