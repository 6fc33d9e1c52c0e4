"""LoFTR with dual softmax (Sun et al., "LoFTR: Detector-Free Local Feature Matching with
Transformers", 2021).
"""

from torch import Tensor

from mkpc_kaggle.matchers.contract import Training
from mkpc_kaggle.matchers.networks.linear_attention import LinearTransformer, Masks
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY, ORIGINAL_DECAY, with_positions
from mkpc_kaggle.matchers.networks.resnet_fpn import TOP
from mkpc_kaggle.matchers.networks.semi_dense import HEADS, SemiDenseNetwork


class Loftr(SemiDenseNetwork):
    """LoFTR. Sides are multiples of 8; the two images may differ in size.

    Indoor weights were trained later, with the corrected position encoding, and were published with
    border 0.
    """

    multiple = 8

    def __init__(self, training: Training = Training.OUTDOOR) -> None:
        super().__init__(LinearTransformer(TOP, HEADS, cycles=4))
        self.decay = ORIGINAL_DECAY
        if training is Training.INDOOR:
            self.decay, self.border = FIXED_DECAY, 0

    def transform(
        self, coarse0: Tensor, coarse1: Tensor, masks: Masks | None = None
    ) -> tuple[Tensor, Tensor]:
        grid0, grid1 = with_positions(coarse0, self.decay), with_positions(coarse1, self.decay)
        flat_masks = None if masks is None else (masks[0].flatten(1), masks[1].flatten(1))
        tokens0, tokens1 = self.loftr_coarse(grid0.flatten(1, 2), grid1.flatten(1, 2), flat_masks)
        return tokens0.view_as(grid0), tokens1.view_as(grid1)
