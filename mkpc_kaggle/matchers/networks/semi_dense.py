"""The shared parts of LoFTR, QuadTree and ASpanFormer: all except their coarse transformers.

In order: backbone, coarse transformer, dual softmax of all pairs of coarse cells, refinement in
fine windows.
"""

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.coarse_matching import coarse_matches
from mkpc_kaggle.matchers.networks.fine_matching import (
    REACH,
    FinePreprocess,
    SemiDenseMatches,
    cell_points,
    cut_windows,
    expected_offset,
)
from mkpc_kaggle.matchers.networks.layers import Assignment
from mkpc_kaggle.matchers.networks.linear_attention import LinearTransformer, MaskPair
from mkpc_kaggle.matchers.networks.resnet_fpn import FINE, TOP, FeatureMaps, ResNetFpn

HEADS = 8
TEMPERATURE = 0.1  # of the dual softmax
# 1,024 have 13 MB of features per image; a pair may have 6,000 matches. A GPU is idle between small
# blocks.
WINDOWS_AT_ONCE = {"cpu": 1024, "cuda": 8192}


class SemiDenseNetwork(nn.Module):
    """A semi-dense network for inference only: in evaluation mode, without gradients.

    ``loftr_coarse`` maps the coarse maps (N, 256, h, w) of both images, and their masks or ``None``,
    to grids (N, h, w, 256). ``border``: the width, in coarse cells, of the margin that gets no
    matches. Confidences of matches exceed ``threshold``.
    """

    threshold = 0.2

    def __init__(
        self, loftr_coarse: nn.Module, border: int = 2, *, learned_temperature: bool = False
    ) -> None:
        super().__init__()
        self.backbone = ResNetFpn()
        self.loftr_coarse = loftr_coarse
        self.border = border
        learned = (
            {"temperature": torch.tensor(1 / TEMPERATURE)} if learned_temperature else {}
        )
        self.coarse_matching = nn.ParameterDict(learned)
        self.fine_preprocess = FinePreprocess(TOP, FINE)
        self.loftr_fine = LinearTransformer(FINE, HEADS, cycles=1)
        self.eval().requires_grad_(False)

    @property
    def similarity_scale(self) -> float | Tensor:
        """Factor of the dot product of two coarse features before the dual softmax."""
        # Each feature is divided by the square root of its number of channels.
        if self.coarse_matching:
            return self.coarse_matching.get_parameter("temperature") / TOP
        return 1 / (TOP * TEMPERATURE)

    def encode(self, image: Tensor) -> FeatureMaps:
        """Encode gray images (B, 1, H, W), float32 in [0, 1]."""
        maps: FeatureMaps = self.backbone(image)
        return maps

    def match(
        self, features0: FeatureMaps, features1: FeatureMaps, masks: MaskPair | None = None
    ) -> SemiDenseMatches:
        """Match a pair; each image's mask (1, H/8, W/8) bool is True at the content, top left."""
        grids = self.loftr_coarse(features0.coarse, features1.coarse, masks)
        check_finite("coarse features", *grids)
        (grid0,), (grid1,) = grids  # (h, w, 256)
        content = None if masks is None else (masks[0][0], masks[1][0])
        coarse = coarse_matches(
            grid0, grid1, self.similarity_scale, self.threshold, self.border, content
        )
        offsets = self.refine(coarse, features0.fine, features1.fine, grid0, grid1)
        points0 = cell_points(coarse.index0, grid0.shape[1])
        corners1 = cell_points(coarse.index1, grid1.shape[1])
        # Only points of image 1 are refined (section 3.4 of the paper).
        return SemiDenseMatches(coarse, points0, corners1 + offsets * REACH)

    def refine(
        self, coarse: Assignment, fine0: Tensor, fine1: Tensor, grid0: Tensor, grid1: Tensor
    ) -> Tensor:
        """Return offsets (M, 2) of matches in image 1, in units of :data:`REACH`.

        Offsets are from the corners of the matches' cells.
        """
        features0 = grid0.flatten(0, 1)  # (L, 256)
        features1 = grid1.flatten(0, 1)  # (S, 256)
        found = []
        at_once = WINDOWS_AT_ONCE.get(coarse.index0.device.type, 1024)
        parts = zip(
            torch.split(coarse.index0, at_once),
            torch.split(coarse.index1, at_once),
            strict=True,
        )
        for cells0, cells1 in parts:
            windows0 = self.fine_preprocess(cut_windows(fine0, cells0), features0[cells0])
            windows1 = self.fine_preprocess(cut_windows(fine1, cells1), features1[cells1])
            refined0, refined1 = self.loftr_fine(windows0, windows1)  # (m, 25, 128) each
            found.append(expected_offset(refined0, refined1))
        return torch.cat(found)
