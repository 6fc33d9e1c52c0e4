"""Dense warps, shared by DKM and RoMa: every pixel's position in the other image, and a certainty.

Normalised coordinates as in warp_refiner. Source: Edstedt et al. 2023, "DKM", section 3.4, and its
published code.
"""

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.grids import as_grid
from mkpc_kaggle.matchers.networks.layers import ExactConv2d, resize
from mkpc_kaggle.matchers.networks.warp_refiner import WarpEstimate, identity_map


class Pyramid(NamedTuple):
    """Features (B, C, h, w) of B images at strides 1, 2, 4, 8 and maybe 16 and 32.

    They have the network's precision.
    """

    levels: tuple[Tensor, ...]

    def at(self, stride: int) -> Tensor:
        return self.levels[stride.bit_length() - 1]  # strides are powers of two


class DenseFeatures(NamedTuple):
    """Features of B images, ``coarse`` for the first pass and ``fine`` for the second, larger one.

    ``coefficients``: (B, n, width) for each Gaussian process of the network, with these images as
    the support. They depend on one image only, so they are cached with its features.
    """

    coarse: Pyramid
    coefficients: tuple[Tensor, ...]
    fine: Pyramid | None = None


class DenseWarp(NamedTuple):
    """Warps of B pairs, float32, on either image's grid.

    ``warp`` (B, H, W, 4) has (x, y) in the first, then the second image, in [-1, 1]. ``certainty``
    (B, H, W) is in [0, 1], and 0 where the target is outside.
    """

    warp: Tensor
    certainty: Tensor

    def swapped(self) -> "DenseWarp":
        """Return the same pairs of points, the other image's coordinates first."""
        first = self.warp[..., :2]
        second = self.warp[..., 2:]
        return DenseWarp(torch.cat([second, first], dim=3), self.certainty)


class WarpDecoder(nn.Module, ABC):
    """A decoder from the features of two images to the flow between them."""

    def forward(
        self, query: DenseFeatures, support: DenseFeatures
    ) -> tuple[WarpEstimate, Tensor]:
        """Return the last pass's estimate at stride 1, and the first pass's logits at stride 16.

        The estimate is from query to support.
        """
        estimate = self.coarse_estimate(query, support)
        logits = estimate.certainty
        estimate = self.refine(estimate, query.coarse, support.coarse)
        if query.fine is not None and support.fine is not None:
            # The second pass starts from the first one's estimate at stride 1, though that is
            # larger than its own stride 8.
            estimate = self.refine(estimate, query.fine, support.fine)
        return estimate, logits

    def refine(
        self, estimate: WarpEstimate, query: Pyramid, support: Pyramid
    ) -> WarpEstimate:
        """Refine an estimate of any size down to stride 1."""
        for stride in (8, 4, 2, 1):
            # Coordinates are normalised, so a resized flow keeps its values.
            resized = estimate.resized(query.at(stride).shape[2:])
            estimate = self.correct(resized, query, support, stride)
        return estimate

    @abstractmethod
    def coarse_estimate(self, query: DenseFeatures, support: DenseFeatures) -> WarpEstimate:
        """Return the refined estimate at stride 16."""

    @abstractmethod
    def correct(
        self, estimate: WarpEstimate, query: Pyramid, support: Pyramid, stride: int
    ) -> WarpEstimate:
        """Correct an estimate, at the size of a stride's features, with that stride's refiner."""


class DenseNetwork(nn.Module, ABC):
    """Features of images, and the warps between two images; for inference only."""

    decoder: WarpDecoder

    @abstractmethod
    def encode(self, image: Tensor, fine: Tensor | None = None) -> DenseFeatures:
        """Encode images (B, 3, H, W) from :func:`pixels.network_input`.

        ``fine``: the same images in a larger size, for a second pass.
        """

    def match(
        self, first: DenseFeatures, second: DenseFeatures
    ) -> tuple[DenseWarp, DenseWarp]:
        """Return the warps of B pairs on the first and on the second image's grid.

        Sizes may differ.
        """
        # Sequential: one batch of both directions would take twice the memory and the same time.
        forward = dense_warp(*self.decoder(first, second))
        backward = dense_warp(*self.decoder(second, first))
        return forward, backward.swapped()


def dense_warp(estimate: WarpEstimate, coarse_logits: Tensor) -> DenseWarp:
    """Return the warp on the query's grid.

    ``coarse_logits`` (B, 1, h, w) are the first pass's at stride 16, also after a second pass.
    """
    flow = estimate.flow
    logits = estimate.certainty
    # Subtract half of the negative coarse logits. This raises the certainty there: half of the
    # coarse evidence against a match is taken back, as published.
    doubts = resize(coarse_logits, logits.shape[2:]).clamp(max=0)
    certainty = torch.sigmoid(logits - 0.5 * doubts)[:, 0]  # (B, H, W)
    outside = (flow.abs() > 1).any(dim=1)  # before the flow is clamped
    pixels = identity_map(flow).expand_as(flow)
    targets = flow.clamp(-1, 1)
    warp = torch.cat([as_grid(pixels), as_grid(targets)], dim=3)  # (B, H, W, 4)
    return DenseWarp(warp, certainty.masked_fill_(outside, 0))


TEMPERATURE = 0.2  # of the kernel
NOISE_VARIANCE = 0.1  # added to the diagonal as it is: it is not squared


class GaussianProcess(nn.Module):
    """A Gaussian process from the support's features to its pixels' coordinates.

    Coordinates are embedded in ``width`` channels. Source: Edstedt et al. 2023, section 3.2.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.pos_conv = ExactConv2d(2, width, 1)

    def regress(self, support: Tensor) -> Tensor:
        """Map features (B, C, h', w') to their kernels' coefficients (B, n', width), float32."""
        embedded = self.embed_coordinates(support)
        return coefficients(tokens(support), tokens(embedded))

    def forward(self, query: Tensor, support: Tensor, coefficients: Tensor) -> Tensor:
        """Return the posterior mean (B, width, h, w) for features (B, C, h, w) and coefficients."""
        mean = kernel(tokens(query), tokens(support)) @ coefficients  # (B, n, width)
        return mean.mT.reshape(len(query), -1, *query.shape[2:])

    def embed_coordinates(self, like: Tensor) -> Tensor:
        """Return the embedded pixel coordinates (1, width, h, w) of a map (..., h, w)."""
        return torch.cos(8 * math.pi * self.pos_conv(identity_map(like)))


def tokens(feature_map: Tensor) -> Tensor:
    """Map (B, C, h, w) to (B, h w, C), float32."""
    return feature_map.float().flatten(2).mT


def coefficients(y: Tensor, values: Tensor) -> Tensor:
    """Return (K_yy + noise)^-1 values, (B, m, D), for y (B, m, C) and values (B or 1, m, D)."""
    check_finite("coarse features", y)
    covariance = kernel(y, y)
    covariance.diagonal(dim1=1, dim2=2).add_(NOISE_VARIANCE)
    # The matrix is positive definite. LU costs twice as much; batched LU is broken in PyTorch's MKL
    # builds (PyTorch's issues 142815 and 141358).
    factor = torch.linalg.cholesky(covariance)
    return torch.cholesky_solve(values.expand(len(y), -1, -1), factor)


def kernel(x: Tensor, y: Tensor) -> Tensor:
    """Return exp((cosine - 1) / T), (B, n, m) float32, of rows of x (B, n, C) and y (B, m, C).

    Computed in float64: the inverse of a covariance amplifies rounding errors about fifteen times,
    and so do the refiners. A pair of 540 x 720 pixels takes 0.1 s on a CPU and 40 ms on a T4.
    """
    x = x.double()
    y = y.double()
    # The published 1e-6 is added to the product of the norms, not to each.
    x_norms = x.norm(dim=2)[:, :, None]
    y_norms = y.norm(dim=2)[:, None]
    norms = (x_norms * y_norms).add_(1e-6)
    cosine = (x @ y.mT).div_(norms)
    # In place: for 1,530 pixels at stride 16 the matrix takes 19 MB.
    return cosine.sub_(1).div_(TEMPERATURE).exp_().float()
