"""Dense warps: for every pixel its position in the other image and a certainty; what DKM and RoMa share.

Normalised coordinates as in warp_refiner. Source: Edstedt et al. 2023, "DKM", section 3.4, and its published code.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.networks.grids import as_grid
from mkpc_kaggle.matchers.networks.warp_refiner import WarpEstimate, identity_map, resize


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Of B images, (B, C, h, w) each, in the network's precision: at strides 1, 2, 4, 8 and maybe more."""

    levels: tuple[Tensor, ...]

    def at(self, stride: int) -> Tensor:
        return self.levels[stride.bit_length() - 1]


@dataclass(frozen=True, eq=False)
class DenseFeatures:
    """Features of B images for the first pass and, of larger versions of them, for the second.

    ``coefficients`` (B, n, C): of each of the network's Gaussian processes, with the images as supports.
    """

    coarse: Pyramid
    coefficients: tuple[Tensor, ...]
    fine: Pyramid | None = None


@dataclass(frozen=True, eq=False)
class DenseWarp:
    """Of B pairs, float32: ``warp`` (B, H, W, 4), (x, y) in the first image and (x, y) in the second, in [-1, 1];
    ``certainty`` (B, H, W) in [0, 1], 0 where the target is outside. The grid is that of one of the images.
    """

    warp: Tensor
    certainty: Tensor

    def swapped(self) -> "DenseWarp":
        """The same pairs of points, the other image's coordinates first."""
        return DenseWarp(torch.cat([self.warp[..., 2:], self.warp[..., :2]], dim=3), self.certainty)


class WarpDecoder(nn.Module, ABC):
    """From the features of two images to the flow from the one to the other."""

    def forward(self, query: DenseFeatures, support: DenseFeatures) -> tuple[WarpEstimate, Tensor]:
        """The flow from query to support at stride 1 of the last pass, and the first pass's logits at 16."""
        estimate = self.coarse_estimate(query, support)
        logits = estimate.certainty
        estimate = self.refine(estimate, query.coarse, support.coarse)
        if query.fine is not None and support.fine is not None:
            estimate = self.refine(estimate, query.fine, support.fine)
        return estimate, logits

    def refine(self, estimate: WarpEstimate, query: Pyramid, support: Pyramid) -> WarpEstimate:
        """Down to stride 1 from an estimate of any size."""
        for stride in (8, 4, 2, 1):
            estimate = self.correct(estimate.resized(query.at(stride).shape[2:]), query, support, stride)
        return estimate

    @abstractmethod
    def coarse_estimate(self, query: DenseFeatures, support: DenseFeatures) -> WarpEstimate:
        """At stride 16, refined."""

    @abstractmethod
    def correct(self, estimate: WarpEstimate, query: Pyramid, support: Pyramid, stride: int) -> WarpEstimate:
        """The estimate, of the size of a stride's features, corrected by that stride's refiner."""


class DenseNetwork(nn.Module, ABC):
    """Features of images, and the warps between two images; for inference only."""

    decoder: WarpDecoder

    @abstractmethod
    def encode(self, image: Tensor, fine: Tensor | None = None) -> DenseFeatures:
        """Images (B, 3, H, W) as :func:`pixels.network_input` makes them; larger ones for a second pass."""

    def match(self, first: DenseFeatures, second: DenseFeatures) -> tuple[DenseWarp, DenseWarp]:
        """B pairs, whose images may differ in size: the warps on the first image's grid and on the second's.

        ValueError where only one of them has features for a second pass.
        """
        if (first.fine is None) != (second.fine is None):
            raise ValueError("of a pair either both images or neither must have features for a second pass")
        # Sequential: one batch of both directions would take twice the memory and as much time.
        forward, backward = (dense_warp(*self.decoder(*both)) for both in ((first, second), (second, first)))
        return forward, backward.swapped()


def dense_warp(estimate: WarpEstimate, coarse_logits: Tensor) -> DenseWarp:
    """One direction on the query's grid; ``coarse_logits`` (B, 1, h, w): those of stride 16, first pass."""
    flow, logits = estimate.flow, estimate.certainty
    # Half of the coarse logits that speak against a match is subtracted again.
    doubts = resize(coarse_logits, logits.shape[2:]).clamp(max=0)
    certainty = torch.sigmoid(logits - 0.5 * doubts)[:, 0]  # (B, H, W)
    outside = (flow.abs() > 1).any(dim=1)
    pixels = identity_map(flow).expand_as(flow)
    warp = torch.cat([as_grid(pixels), as_grid(flow.clamp(-1, 1))], dim=3)  # (B, H, W, 4)
    return DenseWarp(warp, certainty.masked_fill_(outside, 0))
