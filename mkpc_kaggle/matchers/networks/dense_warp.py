"""Dense warps: for every pixel its position in the other image and a certainty; what DKM and RoMa share.

Normalised coordinates as in warp_refiner. Source: Edstedt et al. 2023, "DKM", section 3.4, and its published code.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.grids import as_grid
from mkpc_kaggle.matchers.networks.layers import ExactConv2d
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
        """B pairs, whose images may differ in size: the warps on the first image's grid and on the second's."""
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


TEMPERATURE, NOISE_VARIANCE = 0.2, 0.1


class GaussianProcess(nn.Module):
    """Regresses from the support's features to the coordinates of its pixels, embedded in ``width`` channels.

    Source: Edstedt et al. 2023, section 3.2.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.pos_conv = ExactConv2d(2, width, 1)

    def regress(self, support: Tensor) -> Tensor:
        """Features (B, C, h', w') -> the coefficients (B, n', width) of their kernels, float32."""
        return coefficients(tokens(support), tokens(self.embed_coordinates(support)))

    def forward(self, query: Tensor, support: Tensor, coefficients: Tensor) -> Tensor:
        """Posterior mean (B, width, h, w) of features (B, C, h, w) and (B, C, h', w'), regressed before."""
        mean = kernel(tokens(query), tokens(support)) @ coefficients  # (B, n, width)
        return mean.mT.reshape(len(query), -1, *query.shape[2:])

    def embed_coordinates(self, like: Tensor) -> Tensor:
        """(1, width, h, w) for a map (..., h, w)."""
        return torch.cos(8 * math.pi * self.pos_conv(identity_map(like)))


def tokens(feature_map: Tensor) -> Tensor:
    """(B, C, h, w) -> (B, h w, C), float32."""
    return feature_map.float().flatten(2).mT


def coefficients(y: Tensor, values: Tensor) -> Tensor:
    """(K_yy + noise)^-1 values: (B, m, C) and (B or 1, m, D) -> (B, m, D)."""
    check_finite("coarse features", y)
    covariance = kernel(y, y)
    covariance.diagonal(dim1=1, dim2=2).add_(NOISE_VARIANCE)
    # Positive definite. LU would cost twice as much, and batched it is broken in PyTorch's MKL builds.
    factor = torch.linalg.cholesky(covariance)
    return torch.cholesky_solve(values.expand(len(y), -1, -1), factor)


def kernel(x: Tensor, y: Tensor) -> Tensor:
    """exp((cosine - 1) / T) of all pairs: (B, n, C) and (B, m, C) -> (B, n, m), float32.

    Computed in float64: the inverse of a covariance amplifies rounding errors some fifteen times, and the
    refiners do again. It takes a tenth of a second on a CPU, and 40 ms on a T4 for a pair of 540 x 720.
    """
    x, y = x.double(), y.double()
    norms = (x.norm(dim=2)[:, :, None] * y.norm(dim=2)[:, None]).add_(1e-6)
    return (x @ y.mT).div_(norms).sub_(1).div_(TEMPERATURE).exp_().float()
