"""Gaussian-process regression of coordinates from features: Edstedt et al. 2023, "DKM", section 3.2.

Normalised coordinates as in warp_refiner.
"""

import math

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.layers import ExactConv2d
from mkpc_kaggle.matchers.networks.warp_refiner import identity_map

TEMPERATURE, NOISE_VARIANCE = 0.2, 0.1


class GaussianProcess(nn.Module):
    """Regresses from the support's features to the coordinates of its pixels, embedded in ``width`` channels."""

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
