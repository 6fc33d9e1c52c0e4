"""ResNet with a feature pyramid, of LoFTR and its descendants: maps at 1/8 and 1/2 of the image.

Source: Sun et al. 2021 (LoFTR), section 3.1; layer names as in the public checkpoints.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

# Channels at 1/2, 1/4 and 1/8 of the image, and of the fine output.
STEM = 128
MIDDLE = 196
TOP = 256
FINE = 128


class FeatureMaps(NamedTuple):
    """Maps of B images of H x W pixels, in the precision of the backbone's weights.

    ``coarse`` is (B, 256, H/8, W/8), ``fine`` (B, 128, H/2, W/2).
    """

    coarse: Tensor
    fine: Tensor


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with a shortcut; a strided 1x1 convolution where the size changes."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample = nn.Sequential()
        if stride != 1:
            self.downsample = nn.Sequential(
                nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)
            )

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, inputs, h, w) to (B, outputs, h / stride, w / stride)."""
        y = functional.relu_(self.bn1(self.conv1(x)))
        y = self.bn2(self.conv2(y))
        # In place of ``y``, never of ``x``, which the feature pyramid still reads.
        return functional.relu_(y.add_(self.downsample(x)))


def smoothing(inputs: int, outputs: int) -> nn.Sequential:
    """Return the convolutions that smooth the sum of two pyramid levels."""
    return nn.Sequential(
        nn.Conv2d(inputs, inputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(inputs),
        nn.LeakyReLU(0.01, inplace=True),
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
    )


class ResNetFpn(nn.Module):
    """The backbone: it maps gray images (B, 1, H, W) to :class:`FeatureMaps`.

    Images are float32 in [0, 1]; their sides are multiples of 8.
    """

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(1, STEM, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(STEM)
        self.layer1 = nn.Sequential(ResidualBlock(STEM, STEM), ResidualBlock(STEM, STEM))
        self.layer2 = nn.Sequential(
            ResidualBlock(STEM, MIDDLE, 2), ResidualBlock(MIDDLE, MIDDLE)
        )
        self.layer3 = nn.Sequential(ResidualBlock(MIDDLE, TOP, 2), ResidualBlock(TOP, TOP))
        self.layer3_outconv = nn.Conv2d(TOP, TOP, 1, bias=False)
        self.layer2_outconv = nn.Conv2d(MIDDLE, TOP, 1, bias=False)
        self.layer2_outconv2 = smoothing(TOP, MIDDLE)
        self.layer1_outconv = nn.Conv2d(STEM, MIDDLE, 1, bias=False)
        self.layer1_outconv2 = smoothing(MIDDLE, FINE)
        # Channels-last weights make all activations channels last; loading a checkpoint keeps that.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stubs

    def forward(self, image: Tensor) -> FeatureMaps:
        image = image.to(self.conv1.weight.dtype)
        half = self.layer1(
            functional.relu_(self.bn1(self.conv1(image)))
        )  # (B, 128, H/2, W/2)
        quarter = self.layer2(half)  # (B, 196, H/4, W/4)
        coarse = self.layer3_outconv(self.layer3(quarter))  # (B, 256, H/8, W/8)
        lateral = self.layer2_outconv(quarter).add_(_doubled(coarse))  # (B, 256, H/4, W/4)
        merged = self.layer2_outconv2(lateral)  # (B, 196, H/4, W/4)
        lateral = self.layer1_outconv(half).add_(_doubled(merged))  # (B, 196, H/2, W/2)
        fine = self.layer1_outconv2(lateral)  # (B, 128, H/2, W/2)
        return FeatureMaps(coarse, fine)


def _doubled(x: Tensor) -> Tensor:
    # Corners are aligned here as in training, unlike everywhere else in these networks.
    return functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=True)
