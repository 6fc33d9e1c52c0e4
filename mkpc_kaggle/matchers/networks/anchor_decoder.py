"""RoMa's coarse decoder: where a pixel lies in the other image, as one of 64 x 64 anchors (Edstedt et al. 2024,
section 3.3). Normalised coordinates as in warp_refiner.
"""

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.networks.gaussian_process import tokens
from mkpc_kaggle.matchers.networks.grids import as_grid
from mkpc_kaggle.matchers.networks.layers import ExactLinear
from mkpc_kaggle.matchers.networks.transformer_block import VitBlock
from mkpc_kaggle.matchers.networks.warp_refiner import Estimate, identity_map

SIDE = 64  # of the grid of anchors, whatever the images' shape
EPSILON = 1e-5  # of the norms


class AnchorDecoder(nn.Module):
    """A transformer without positions; those are in the posterior."""

    def __init__(self, width: int, blocks: int, heads: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            VitBlock(width, heads, EPSILON, bias=False, scaled=False) for _ in range(blocks)
        )
        self.to_out = ExactLinear(width, SIDE**2 + 1)

    def forward(self, posterior: Tensor, features: Tensor) -> Estimate:
        """Maps (B, C, h, w) and (B, C', h, w) of the query, C + C' the width -> the first estimate."""
        x = torch.cat([tokens(posterior), tokens(features)], dim=2)  # (B, h w, C + C')
        for block in self.blocks:
            x = block(x)
        logits = self.to_out(x)  # (B, h w, 4097)
        size = posterior.shape[2:]
        flow, certainty = anchor_mean(logits[..., :-1]), logits[..., -1:]
        return Estimate(*(each.mT.reshape(len(x), -1, *size) for each in (flow, certainty)))


def anchor_mean(logits: Tensor) -> Tensor:
    """The mean place (..., 2) of the most likely anchor of (..., 4096) and its four neighbours, by probability.

    As in training, neighbours are next in a row or 64 away, also across the ends of rows; those before the first
    anchor or after the last count as that one.
    """
    best = logits.argmax(dim=-1, keepdim=True)
    offsets = torch.tensor([-1, 0, 1, -SIDE, SIDE], device=logits.device)
    near = (best + offsets).clamp(0, SIDE**2 - 1)  # (..., 5)
    places = as_grid(identity_map(logits.new_empty(SIDE, SIDE))).reshape(-1, 2)  # (4096, 2)
    shares = logits.gather(-1, near).softmax(dim=-1)
    return (shares[..., None] * places[near]).sum(dim=-2)
