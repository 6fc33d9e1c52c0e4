"""ResNet-50 as a pyramid of features: He et al., "Deep Residual Learning for Image Recognition", 2016.

Written here because offline installs have no torchvision. The stride of a bottleneck sits in its 3x3 convolution.
Parameter names are the usual ones. For inference in
evaluation mode only.
"""

from torch import Tensor, nn
from torch.nn import functional

EXPANSION = 4


class Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolutions beside a shortcut, which is a 1x1 convolution where the shape changes."""

    def __init__(self, inputs: int, width: int, stride: int = 1) -> None:
        super().__init__()
        outputs = EXPANSION * width
        self.conv1 = nn.Conv2d(inputs, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.downsample = nn.Sequential()
        if inputs != outputs:
            self.downsample = nn.Sequential(
                nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)
            )

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, h, w) -> (B, 4 width, ceil(h / stride), ceil(w / stride))."""
        y = functional.relu_(self.bn1(self.conv1(x)))
        y = functional.relu_(self.bn2(self.conv2(y)))
        return functional.relu_(self.bn3(self.conv3(y)).add_(self.downsample(x)))


def stage(inputs: int, width: int, blocks: int, stride: int) -> nn.Sequential:
    later = [Bottleneck(EXPANSION * width, width) for _ in range(blocks - 1)]
    return nn.Sequential(Bottleneck(inputs, width, stride), *later)


class ResNet50(nn.Module):
    """The classifier is there because checkpoints have it; it is not used."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.layer1 = stage(64, 64, blocks=3, stride=1)
        self.layer2 = stage(256, 128, blocks=4, stride=2)
        self.layer3 = stage(512, 256, blocks=6, stride=2)
        self.layer4 = stage(1024, 512, blocks=3, stride=2)
        self.fc = nn.Linear(2048, 1000)

    def forward(self, image: Tensor, coarsest: int = 32) -> tuple[Tensor, ...]:
        """Features at strides 2, 4, 8, 16 and 32, as far as ``coarsest``, of images (B, 3, H, W) of any size.

        (B, C, h, w) with C = 64, 256, 512, 1024, 2048; every halving of a side rounds up.
        """
        levels = [functional.relu_(self.bn1(self.conv1(image)))]
        x = functional.max_pool2d(levels[0], 3, stride=2, padding=1)
        for stride, layer in zip(
            (4, 8, 16, 32), (self.layer1, self.layer2, self.layer3, self.layer4), strict=True
        ):
            if stride <= coarsest:
                x = layer(x)
                levels.append(x)
        return tuple(levels)
