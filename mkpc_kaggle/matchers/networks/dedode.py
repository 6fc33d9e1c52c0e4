"""DeDoDe descriptors as in LoMa: a dense map, sampled at keypoints (Edstedt et al. 2024).

arXiv 2308.08479. The decoder, which DaD shares, runs from coarse to fine. At each stride, a refiner
reads the features and the coarser stride's context, adds to the prediction and outputs a context.
Predictions are float32 in any precision. Variant B uses VGG-19 alone; G adds DINOv2 at stride 14.
Coordinates are normalised as in dad. Parameter names match the public checkpoints. For inference
only.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.networks.dinov2 import DinoV2
from mkpc_kaggle.matchers.networks.layers import (
    ExactConv2d,
    depthwise_block,
    in_strips,
    resize,
)
from mkpc_kaggle.matchers.networks.vgg import VGG19, Vgg

REACH = 2  # pixels that a depthwise convolution reads on each side
BLOCKS = 5  # of a refiner, after the first


class DedodeRefinerShape(NamedTuple):
    """Channels of the input ``features``, of ``hidden`` layers, and of the output ``context``."""

    features: int
    hidden: int
    context: int


SHAPES = {  # by stride
    14: DedodeRefinerShape(1024, 768, 512),
    8: DedodeRefinerShape(512, 512, 256),
    4: DedodeRefinerShape(256, 256, 128),
    2: DedodeRefinerShape(128, 64, 32),
    1: DedodeRefinerShape(64, 32, 1),
}


class DedodeRefiner(nn.Module):
    """1x1 convolutions of features and context, then depthwise 5x5 and 1x1 ones in turns.

    The first convolution is split: its half for the features runs while the encoder yields them,
    its half for the context when the coarser stride is done. So no features stay in memory.
    """

    def __init__(
        self, shape: DedodeRefinerShape, context: int, prediction: int, blocks: int
    ) -> None:
        super().__init__()
        width = shape.hidden
        self.features = shape.features
        self.block1 = nn.Sequential(
            nn.Conv2d(shape.features + context, width, 1),
            nn.BatchNorm2d(width),
            nn.ReLU(inplace=True),
            nn.Conv2d(width, width, 1),
        )
        self.hidden_blocks = nn.Sequential(
            *(depthwise_block(width, width) for _ in range(blocks))
        )
        self.out_conv = ExactConv2d(width, prediction + shape.context, 1)

    def entry(self, features: Tensor) -> Tensor:
        """Return the first convolution (B, hidden, h, w) of features (B, C, h, w) alone."""
        weight = self.block1.get_parameter("0.weight")
        bias = self.block1.get_parameter("0.bias")
        # Of the input channels, features come first and the context last.
        return functional.conv2d(features.to(weight.dtype), weight[:, : self.features], bias)

    def mixed(self, entry: Tensor, context: Tensor | None) -> Tensor:
        """Add the coarser context to an :meth:`entry`, in place; return the map after block 1.

        The map is (B, hidden, h, w).
        """
        first, norm, relu, mix = self.block1
        if context is not None:
            # A 1x1 convolution and enlargement commute; the small map is cheaper.
            weight = first.get_parameter("weight")[:, self.features :]
            added = functional.conv2d(context.to(weight.dtype), weight)
            entry += resize(added, entry.shape[2:])
        mixed: Tensor = mix(relu(norm(entry)))
        return mixed

    def hidden(self, mixed: Tensor) -> Tensor:
        """Return the scaled sum (B, hidden, h, w) of a :meth:`mixed` map and the blocks' output."""
        reach = REACH * len(self.hidden_blocks)
        return in_strips(self._hidden, mixed, reach=reach, channels=mixed.shape[1])

    def outputs(self, hidden: Tensor) -> Tensor:
        """Return (B, n, h, w) float32: the channels of the prediction, then of the context."""
        found: Tensor = self.out_conv(hidden.float())
        return found

    def _hidden(self, mixed: Tensor) -> Tensor:
        blocks: Tensor = self.hidden_blocks(mixed)
        # The published divisor of a sum of two, about the square root of 2.
        return blocks.add_(mixed).div_(1.4)


class DedodeDecoder(nn.Module):
    """A decoder to ``prediction`` channels with ``blocks`` per refiner.

    Predictions are upsampled in ``mode``: bilinear for descriptors, bicubic for DaD's logits.
    """

    def __init__(
        self, strides: Sequence[int], prediction: int, blocks: int, mode: str
    ) -> None:
        super().__init__()
        self.prediction = prediction
        self.mode = mode
        self.layers = nn.ModuleDict()
        context = 0
        for stride in strides:
            self.layers[str(stride)] = DedodeRefiner(
                SHAPES[stride], context, prediction, blocks
            )
            context = SHAPES[stride].context

    def at(self, stride: int) -> DedodeRefiner:
        refiner = self.layers[str(stride)]
        assert isinstance(refiner, DedodeRefiner)
        return refiner

    def forward(self, levels: Iterable[Tensor]) -> tuple[Tensor, Tensor]:
        """Return stride 2's prediction (B, n, h, w) and stride 1's hidden map (B, 32, H, W).

        The last step, stride 1's prediction, is left to the caller: a descriptor needs it at
        keypoints only. ``levels`` yields the features from fine to coarse, so that only one level
        is in memory at a time.
        """
        strides = [int(stride) for stride in self.layers]
        # A for loop would keep a level in memory while the next one is computed.
        entries = list(map(DedodeRefiner.entry, map(self.at, reversed(strides)), levels))
        prediction: Tensor | None = None
        context: Tensor | None = None
        for stride in strides[:-1]:
            refiner = self.at(stride)
            hidden = refiner.hidden(refiner.mixed(entries.pop(), context))
            part, context = refiner.outputs(hidden).tensor_split([self.prediction], dim=1)
            if prediction is not None:
                part += resize(prediction, part.shape[2:], self.mode)
            prediction = part
        assert prediction is not None
        finest = self.at(1)
        return prediction, finest.hidden(finest.mixed(entries.pop(), context))


class Dedode(nn.Module):
    """A descriptor: variant G ``with_vit``, otherwise B, which uses VGG's features alone."""

    def __init__(self, channels: int, *, with_vit: bool) -> None:
        super().__init__()
        self.encoder = VggAndVit() if with_vit else Vgg(VGG19)
        strides = (14, 8, 4, 2, 1) if with_vit else (8, 4, 2, 1)
        self.decoder = DedodeDecoder(strides, channels, BLOCKS, "bilinear")
        self.eval().requires_grad_(False)

    def forward(self, image: Tensor, points: Tensor) -> Tensor:
        """Return descriptors (B, K, D) at points (B, K, 2) of images (B, 3, H, W) in 0..1.

        Descriptors are float32, of any length. The images' colours are not normalised. Beyond the
        image, descriptors fade to 0 within a pixel.
        """
        prediction, hidden = self.decoder(self.encoder.levels(image))
        size = hidden.shape[2:]
        # The full-resolution map, 629 MB at 784 x 784, is never computed, only its two parts at the
        # points: stride 1's own, and the enlarged prediction of stride 2.
        head = self.decoder.at(1).out_conv
        weight = head.weight[: self.decoder.prediction]  # without the context's channel
        bias = head.get_parameter("bias")[: self.decoder.prediction]
        read = functional.grid_sample(hidden.float(), points[:, None], align_corners=False)
        fine = functional.linear(read[:, :, 0].mT, weight.flatten(1))  # (B, K, D)

        pixels, shares = nearest_pixels(points, size)
        enlarged = read_enlarged(prediction, pixels, shares, size)  # (B, K, D)
        # Beyond the image the shares sum to less than 1, and the bias fades like the features.
        return enlarged + fine + shares.sum(dim=2, keepdim=True) * bias


def nearest_pixels(points: Tensor, size: torch.Size) -> tuple[Tensor, Tensor]:
    """Return the four pixels around points (B, K, 2) and their bilinear weights (B, K, 4).

    Pixels are (B, K, 4, 2), (column, row). Outside an image of ``size`` (height, width) they have
    weight 0.
    """
    extent = points.new_tensor([size[1], size[0]])
    positions = ((points + 1) * extent - 1) / 2  # in pixels, centres at integers
    corners = positions.floor()
    steps = points.new_tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
    pixels = corners[:, :, None] + steps
    distances = (positions[:, :, None] - pixels).abs()
    shares = (1 - distances).prod(dim=3)
    inside = ((pixels >= 0) & (pixels < extent)).all(dim=3)
    return pixels, shares.where(inside, 0)


def read_enlarged(x: Tensor, pixels: Tensor, shares: Tensor, size: torch.Size) -> Tensor:
    """Return sums (B, K, C) of pixels of a map (B, C, h, w) enlarged to ``size``.

    ``shares`` (B, K, 4) weight the pixels (B, K, 4, 2).
    """
    extent = pixels.new_tensor([size[1], size[0]])
    centres = (2 * pixels + 1) / extent - 1
    # At a pixel's centre, a bilinear sample of the small map is the enlarged map's value. Enlarging
    # repeats the border. (B, C, K, 4)
    read = functional.grid_sample(x, centres, padding_mode="border", align_corners=False)
    return (read * shares[:, None]).sum(dim=3).mT


class VggAndVit(nn.Module):
    """VGG's features, then DINOv2's; sides of images must be multiples of 14."""

    def __init__(self) -> None:
        super().__init__()
        self.vgg = Vgg(VGG19)
        self.frozen_dinov2 = nn.ModuleDict({"dinov2_vitl14": DinoV2()})

    def levels(self, image: Tensor) -> Iterator[Tensor]:
        """Yield the features at strides 1, 2, 4, 8 and 14."""
        yield from self.vgg.levels(image)
        yield self.frozen_dinov2["dinov2_vitl14"](image)
