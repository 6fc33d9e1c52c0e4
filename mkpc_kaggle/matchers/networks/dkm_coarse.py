"""DKM's global matcher: Gaussian-process regression of coordinates, and the decoder of what it gives.

Source: Edstedt et al. 2023, section 3.2. Normalised coordinates as in dkm_refiner.
"""

import math

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.networks.dkm_refiner import Estimate, identity_map
from mkpc_kaggle.matchers.networks.layers import ExactConv2d

STRIDES = (32, 16)
FEATURES, POSTERIOR, WIDTH = 512, 256, 384  # channels
TEMPERATURE, NOISE_VARIANCE = 0.2, 0.1


class GaussianProcess(nn.Module):
    """Regresses from the support's features to the embedded coordinates of its pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.pos_conv = ExactConv2d(2, POSTERIOR, 1)

    def forward(self, query: Tensor, support: Tensor) -> Tensor:
        """Posterior mean (B, 256, h, w) of features (B, 512, h, w) and (B, 512, h', w')."""
        x, y = query.float().flatten(2).mT, support.float().flatten(2).mT  # (B, n, 512), (B, n', 512)
        coordinates = self.embed_coordinates(support).flatten(2).mT  # (1, n', 256)
        mean = posterior_mean(x, y, coordinates)  # (B, n, 256)
        return mean.mT.reshape(len(query), POSTERIOR, *query.shape[2:])

    def embed_coordinates(self, like: Tensor) -> Tensor:
        """(1, 256, h, w) for a map (..., h, w)."""
        return torch.cos(8 * math.pi * self.pos_conv(identity_map(like)))


def posterior_mean(x: Tensor, y: Tensor, values: Tensor) -> Tensor:
    """K_xy (K_yy + noise)^-1 values: (B, n, C), (B, m, C) and (B or 1, m, D) -> (B, n, D)."""
    covariance = kernel(y, y)
    covariance.diagonal(dim1=1, dim2=2).add_(NOISE_VARIANCE)
    # Positive definite. LU would cost twice as much, and batched it is broken in PyTorch's MKL builds.
    factor = torch.linalg.cholesky(covariance)
    return kernel(x, y) @ torch.cholesky_solve(values.expand(len(y), -1, -1), factor)


def kernel(x: Tensor, y: Tensor) -> Tensor:
    """exp((cosine - 1) / T) of all pairs: (B, n, C) and (B, m, C) -> (B, n, m), float32.

    Computed in float64: the inverse of a covariance magnifies its rounding some fifteen times, and the refiners
    that again, up to the tolerance of the golden vectors on some processors. It takes a tenth of a
    second on a CPU. For a pair of 540 x 720, both ways, these products are 10.2 GFLOP (1530 cells at stride 16,
    391 at 32): 40 ms at the peak of a T4, whose float64 has 1/32 of its float32's rate.
    """
    x, y = x.double(), y.double()
    norms = (x.norm(dim=2)[:, :, None] * y.norm(dim=2)[:, None]).add_(1e-6)
    return (x @ y.mT).div_(norms).sub_(1).div_(TEMPERATURE).exp_().float()


class EmbeddingDecoder(nn.Module):
    """Turns the posterior into a first estimate, scale by scale, with a context that goes on to the next."""

    def __init__(self) -> None:
        super().__init__()
        self.feat_input_modules = nn.ModuleDict({str(s): nn.Conv2d(FEATURES, 256, 1) for s in STRIDES})
        self.rrb_d = nn.ModuleDict({str(s): ResidualRefinement(256 + POSTERIOR) for s in STRIDES})
        self.cab = nn.ModuleDict({str(s): ChannelAttention() for s in STRIDES})
        self.rrb_u = nn.ModuleDict({str(s): ResidualRefinement(WIDTH) for s in STRIDES})
        self.terminal_module = nn.ModuleDict({str(s): ExactConv2d(WIDTH, 3, 1) for s in STRIDES})

    def forward(
        self, stride: int, posterior: Tensor, features: Tensor, context: Tensor
    ) -> tuple[Estimate, Tensor]:
        """Maps (B, 256, h, w), (B, 512, h, w) and (B, 384, h, w) -> the estimate and the next context."""
        at = str(stride)
        own = self.feat_input_modules[at](features)
        embedded = torch.cat([own, posterior.to(own.dtype)], dim=1)  # (B, 512, h, w)
        context = self.rrb_u[at](self.cab[at](context, self.rrb_d[at](embedded)))
        found = self.terminal_module[at](context.float())  # (B, 3, h, w)
        return Estimate(found[:, 1:], found[:, :1]), context


class ResidualRefinement(nn.Module):
    """Two 3x3 convolutions beside a shortcut, after a 1x1 one that sets the width."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, WIDTH, 1)
        self.conv2 = nn.Conv2d(WIDTH, WIDTH, 3, padding=1)
        self.bn = nn.BatchNorm2d(WIDTH)
        self.conv3 = nn.Conv2d(WIDTH, WIDTH, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, h, w) -> (B, 384, h, w)."""
        x = self.conv1(x)
        y = self.conv3(torch.relu_(self.bn(self.conv2(x))))
        return torch.relu_(y.add_(x))


class ChannelAttention(nn.Module):
    """Adds the new embedding to the context, channel by channel as much as the means of both call for."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(2 * WIDTH, WIDTH, 1)
        self.conv2 = nn.Conv2d(WIDTH, WIDTH, 1)

    def forward(self, context: Tensor, embedded: Tensor) -> Tensor:
        """(B, 384, h, w) each -> (B, 384, h, w)."""
        means = torch.cat([context, embedded], dim=1).mean(dim=(2, 3), keepdim=True)  # (B, 768, 1, 1)
        weights = self.conv2(self.conv1(means).relu_()).sigmoid_()
        return torch.addcmul(context, weights, embedded)
