"""LoFTR with dual softmax.

Source: Sun et al., "LoFTR: Detector-Free Local Feature Matching with Transformers", 2021.
"""

from torch import Tensor

from mkpc_kaggle.matchers.contract import Training
from mkpc_kaggle.matchers.networks.linear_attention import LinearTransformer, MaskPair
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY, ORIGINAL_DECAY, with_positions
from mkpc_kaggle.matchers.networks.resnet_fpn import TOP
from mkpc_kaggle.matchers.networks.semi_dense import HEADS, SemiDenseNetwork


class LoftrTransformer(LinearTransformer):
    """The coarse transformer: linear attention after positions of a ``decay``."""

    def __init__(self, decay: float) -> None:
        super().__init__(TOP, HEADS, cycles=4)
        self.decay = decay

    def forward(
        self, coarse0: Tensor, coarse1: Tensor, masks: MaskPair | None = None
    ) -> tuple[Tensor, Tensor]:
        """Map (N, 256, h, w) of both images to (N, h, w, 256)."""
        grid0 = with_positions(coarse0, self.decay)  # (N, h, w, 256)
        grid1 = with_positions(coarse1, self.decay)
        # Linear attention has no notion of rows and columns: cells become tokens (N, h w, 256).
        flat_masks = None if masks is None else (masks[0].flatten(1), masks[1].flatten(1))
        tokens0, tokens1 = super().forward(
            grid0.flatten(1, 2), grid1.flatten(1, 2), flat_masks
        )
        return tokens0.view_as(grid0), tokens1.view_as(grid1)


class Loftr(SemiDenseNetwork):
    """LoFTR. Sides are multiples of 8; the two images may differ in size.

    Indoor weights were trained later, with the corrected position encoding, and were published with
    border 0.
    """

    def __init__(self, training: Training = Training.OUTDOOR) -> None:
        indoor = training is Training.INDOOR
        # A wrong encoding loads without an error, and matches become worse.
        decay = FIXED_DECAY if indoor else ORIGINAL_DECAY
        super().__init__(LoftrTransformer(decay), border=0 if indoor else 2)
