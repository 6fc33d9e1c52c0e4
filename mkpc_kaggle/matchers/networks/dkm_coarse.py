"""The decoder of DKM's global matcher, from the Gaussian process's posterior to a first estimate.

Source: Edstedt et al. 2023, section 3.2. Normalised coordinates as in warp_refiner.
"""

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.networks.layers import ExactConv2d
from mkpc_kaggle.matchers.networks.warp_refiner import Estimate

STRIDES = (32, 16)
FEATURES, POSTERIOR, WIDTH = 512, 256, 384  # channels


class EmbeddingDecoder(nn.Module):
    """Turns the posterior into a first estimate, scale by scale, with a context passed to the next."""

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
    """Adds the new embedding to the context, with a weight per channel from the means of both."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(2 * WIDTH, WIDTH, 1)
        self.conv2 = nn.Conv2d(WIDTH, WIDTH, 1)

    def forward(self, context: Tensor, embedded: Tensor) -> Tensor:
        """(B, 384, h, w) each -> (B, 384, h, w)."""
        means = torch.cat([context, embedded], dim=1).mean(dim=(2, 3), keepdim=True)  # (B, 768, 1, 1)
        weights = self.conv2(self.conv1(means).relu_()).sigmoid_()
        return torch.addcmul(context, weights, embedded)
