"""The decoder of DeDoDe (Edstedt et al. 2024, arXiv 2308.08479) and of the detector DaD: maps, coarse to fine.

At each stride a refiner looks at the features there and at the context of the coarser strides, adds to the
prediction and passes on a context. Predictions are float32 in any precision.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.networks.layers import ExactConv2d, in_strips

KERNEL = 5
CHANNELS = 32  # of a prediction that are enlarged at a time


@dataclass(frozen=True)
class DedodeRefinerShape:
    """Channels: of the ``features`` looked at, inside, and of the ``context`` passed on."""

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
    """1x1 convolutions of features and context, then alternating depthwise 5x5 and 1x1 convolutions."""

    def __init__(self, shape: DedodeRefinerShape, context: int, prediction: int, blocks: int) -> None:
        super().__init__()
        width = shape.hidden
        self.features = shape.features
        self.block1 = nn.Sequential(
            nn.Conv2d(shape.features + context, width, 1), *normalised(width), nn.Conv2d(width, width, 1)
        )
        self.hidden_blocks = nn.Sequential(*(block(width) for _ in range(blocks)))
        self.out_conv = ExactConv2d(width, prediction + shape.context, 1)

    def entry(self, features: Tensor) -> Tensor:
        """What the first convolution makes of features (B, C, h, w) alone: (B, hidden, h, w)."""
        weight, bias = (self.block1.get_parameter(f"0.{name}") for name in ("weight", "bias"))
        return functional.conv2d(features.to(weight.dtype), weight[:, : self.features], bias)

    def mixed(self, entry: Tensor, context: Tensor | None) -> Tensor:
        """(B, hidden, h, w) from an :meth:`entry`, which is overwritten, and the coarser stride's context."""
        first, norm, relu, mix = self.block1
        if context is not None:
            # A 1x1 convolution of the enlarged context is the enlarged one of the context.
            weight = first.get_parameter("weight")[:, self.features :]
            entry += resize(functional.conv2d(context.to(weight.dtype), weight), entry.shape[2:], "bilinear")
        mixed: Tensor = mix(relu(norm(entry)))
        return mixed

    def hidden(self, mixed: Tensor) -> Tensor:
        """What is in :meth:`mixed` and what the blocks make of it: (B, hidden, h, w) again."""
        reach = KERNEL // 2 * len(self.hidden_blocks)
        return in_strips(self._hidden, mixed, reach=reach, channels=mixed.shape[1])

    def outputs(self, hidden: Tensor, which: slice = slice(None)) -> Tensor:
        """(B, n, h, w) float32: ``which`` of the channels, the prediction's first and then the context's."""
        weight, bias = (self.out_conv.get_parameter(name)[which] for name in ("weight", "bias"))
        return functional.conv2d(hidden.float(), weight, bias)

    def _hidden(self, mixed: Tensor) -> Tensor:
        blocks: Tensor = self.hidden_blocks(mixed)
        return blocks.add_(mixed).div_(1.4)


class DedodeDecoder(nn.Module):
    """``prediction`` channels, ``blocks`` in each refiner; it is upsampled in interpolate's ``mode``."""

    def __init__(self, strides: Sequence[int], prediction: int, blocks: int, mode: str) -> None:
        super().__init__()
        self.prediction, self.mode = prediction, mode
        self.layers = nn.ModuleDict()
        context = 0
        for stride in strides:
            self.layers[str(stride)] = DedodeRefiner(SHAPES[stride], context, prediction, blocks)
            context = SHAPES[stride].context

    @property
    def last(self) -> DedodeRefiner:
        return self.at(1)

    def at(self, stride: int) -> DedodeRefiner:
        refiner = self.layers[str(stride)]
        assert isinstance(refiner, DedodeRefiner)
        return refiner

    def forward(self, levels: Iterable[Tensor]) -> tuple[Tensor, Tensor]:
        """The prediction (B, prediction, h, w) after stride 2, and the last refiner's hidden map, (B, 32, H, W).

        ``levels`` are the features from fine to coarse, computed one by one, so that none is kept in memory
        once the next is requested.
        """
        strides = [int(stride) for stride in self.layers]
        # A for loop would keep the features alive while the next ones are computed.
        entries = list(map(self.entry, reversed(strides), levels))
        prediction: Tensor | None = None
        context: Tensor | None = None
        for stride in strides[:-1]:
            prediction, context = self.refined(stride, entries.pop(), prediction, context)
        assert prediction is not None
        mixed = self.last.mixed(entries.pop(), context)
        return prediction, self.last.hidden(mixed)

    def entry(self, stride: int, features: Tensor) -> Tensor:
        return self.at(stride).entry(features)

    def refined(
        self, stride: int, entry: Tensor, prediction: Tensor | None, context: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The prediction with what this stride adds, and its context."""
        refiner = self.at(stride)
        hidden = refiner.hidden(refiner.mixed(entry, context))
        del entry  # the maps that follow are the most that is in memory at a time
        part = refiner.outputs(hidden, slice(self.prediction))
        context = refiner.outputs(hidden, slice(self.prediction, None))
        if prediction is not None:
            # In parts, since at stride 2 the enlarged one is the largest map of all.
            chunks = (torch.split(map_, CHANNELS, dim=1) for map_ in (part, prediction))
            for some, coarser in zip(*chunks, strict=True):
                some.add_(resize(coarser, some.shape[2:], self.mode))
        return part, context


def resize(x: Tensor, size: torch.Size, mode: str) -> Tensor:
    """(B, C, h, w) -> (B, C, *size), without antialiasing, half-pixel centres."""
    return functional.interpolate(x, tuple(size), mode=mode, align_corners=False)


def block(width: int) -> nn.Sequential:
    depthwise = nn.Conv2d(width, width, KERNEL, padding=KERNEL // 2, groups=width)
    return nn.Sequential(depthwise, *normalised(width), nn.Conv2d(width, width, 1))


def normalised(width: int) -> tuple[nn.Module, nn.Module]:
    return nn.BatchNorm2d(width), nn.ReLU(inplace=True)
