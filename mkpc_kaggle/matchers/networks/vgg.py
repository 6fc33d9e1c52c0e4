"""VGG with batch norms as a pyramid of features.

Source: Simonyan and Zisserman, "Very Deep Convolutional Networks", 2015. Written here because
offline installs have no torchvision. Layers are numbered as in the usual classifiers, so the
parameter names are ``layers.N``. For inference in evaluation mode only.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.networks.layers import in_strips

WIDTHS = (64, 128, 256, 512)  # channels at strides 1, 2, 4 and 8
# The numbers of convolutions at each of these strides.
VGG11 = (1, 1, 2, 2)
VGG19 = (2, 2, 4, 4)


class Vgg(nn.Module):
    """VGG up to stride 8, without the last level of the classifiers."""

    def __init__(self, convolutions: Sequence[int]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width_in = 3
        for count, width in zip(convolutions, WIDTHS, strict=True):
            if layers:
                layers.append(nn.MaxPool2d(2))
            for _ in range(count):
                layers += convolution(width_in, width)
                width_in = width
        # One list, as the numbers in the checkpoints' names count all layers.
        self.layers = nn.Sequential(*layers)
        self.convolutions = tuple(convolutions)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Return features (B, C, h, w) at strides 1, 2, 4 and 8 of images (B, 3, H, W).

        They are taken before the next pooling. Sides of images are at least 8; every halving rounds
        down.
        """
        return list(self.levels(image))

    def levels(self, image: Tensor) -> Iterator[Tensor]:
        """Yield the features of :meth:`forward` one by one, so that not all are in memory."""
        first = next(self.parameters())
        x = image.to(first.dtype).contiguous(memory_format=torch.channels_last)
        pools = [i for i, layer in enumerate(self.layers) if isinstance(layer, nn.MaxPool2d)]
        # Layers between two pools are one level; the first level has no pool before it.
        ends = pairwise([-1, *pools, len(self.layers)])
        for number, (pool, end) in enumerate(ends):
            if number > 0:
                x = self.layers[pool](x)
            level = self.layers[pool + 1 : end]
            # A 3x3 convolution reads one row on each side.
            x = in_strips(level, x, reach=self.convolutions[number], channels=WIDTHS[number])
            yield x


def convolution(width_in: int, width_out: int) -> tuple[nn.Module, ...]:
    """Make a 3x3 convolution with its batch norm and ReLU: three numbers of the checkpoint."""
    return (
        nn.Conv2d(width_in, width_out, 3, padding=1),
        nn.BatchNorm2d(width_out),
        nn.ReLU(inplace=True),
    )
