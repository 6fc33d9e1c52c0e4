"""DKM v3, a dense matcher with features of ResNet-50.

Source: Edstedt et al., "DKM: Dense Kernelized Feature Matching for Geometry Estimation", CVPR 2023.

Every pixel of each image gets a position in the other image and a certainty. Images of a pair may
differ in size; the published code needs equal sizes. Correlation windows and corrections are in
pixels of the query. Coordinates are normalised: (x, y) in [-1, 1], where +-1 are the outer edges of
an image (see warp_refiner). Parameter names match the public checkpoints. For inference only.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.networks.dense_warp import (
    DenseFeatures,
    DenseNetwork,
    GaussianProcess,
    Pyramid,
    WarpDecoder,
)
from mkpc_kaggle.matchers.networks.layers import ExactConv2d, resize
from mkpc_kaggle.matchers.networks.warp_refiner import (
    SHAPES,
    WarpEstimate,
    WarpRefiner,
    refined,
)

STRIDES = (32, 16)  # of the coarse decoder
# Channels of the coarse decoder.
FEATURES = 512  # of the projected features
POSTERIOR = 256  # of the Gaussian process, and of the features that join it
WIDTH = 384  # of the context
EXPANSION = 4  # of the channels in a bottleneck of ResNet-50


class DKM(DenseNetwork):
    """DKM v3, trained at 540 x 720 (outdoor; second pass 864 x 1152) and 480 x 640 (indoor)."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.ModuleDict({"net": ResNet50()})
        self.decoder: DkmDecoder = DkmDecoder()
        # Channels-last weights make all maps channels last; loading a checkpoint keeps that.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stubs
        self.eval().requires_grad_(False)

    def encode(self, image: Tensor, fine: Tensor | None = None) -> DenseFeatures:
        """Encode images of any size."""
        coarse = self.decoder.projected(self.pyramid(image))
        second = None if fine is None else self.pyramid(fine)
        return DenseFeatures(coarse, self.decoder.regress(coarse), second)

    def pyramid(self, image: Tensor) -> Pyramid:
        """Return the image (B, 3, H, W) itself and its features at strides 2 to 32."""
        # The last refiner compares the colours themselves, so the image is the first level.
        image = image.contiguous(memory_format=torch.channels_last)
        precision = self.encoder.get_parameter("net.conv1.weight").dtype
        levels = self.encoder["net"](image.to(precision))
        return Pyramid((image, *levels))


class DkmDecoder(WarpDecoder):
    def __init__(self) -> None:
        super().__init__()
        self.embedding_decoder = EmbeddingDecoder()
        self.gps = nn.ModuleDict({str(s): GaussianProcess(POSTERIOR) for s in STRIDES})
        self.proj = nn.ModuleDict(
            {
                "16": nn.Conv2d(1024, FEATURES, 1),
                "32": nn.Conv2d(2048, FEATURES, 1),
            }
        )
        self.conv_refiner = nn.ModuleDict(
            {str(s): WarpRefiner(shape) for s, shape in SHAPES.items()}
        )

    def projected(self, pyramid: Pyramid) -> Pyramid:
        """Return the pyramid of all six strides, projected to 512 channels at strides 16 and 32."""
        *finer, at16, at32 = pyramid.levels
        projected16 = self.proj["16"](at16)
        projected32 = self.proj["32"](at32)
        return Pyramid((*finer, projected16, projected32))

    def regress(self, support: Pyramid) -> tuple[Tensor, ...]:
        """Return the coefficients of the Gaussian processes, in the order of :data:`STRIDES`."""
        processes = zip(self.gps.values(), STRIDES, strict=True)
        return tuple(process.regress(support.at(stride)) for process, stride in processes)  # type: ignore[operator]

    def coarse_estimate(self, query: DenseFeatures, support: DenseFeatures) -> WarpEstimate:
        """Return the estimate at stride 16; of stride 32 only the context is used."""
        first = query.coarse
        second = support.coarse
        batch, _, height, width = first.at(32).shape
        context = first.at(32).new_zeros(batch, WIDTH, height, width)
        for stride, coefficients in zip(STRIDES, support.coefficients, strict=True):
            features = first.at(stride)
            posterior = self.gps[str(stride)](features, second.at(stride), coefficients)
            context = resize(context, features.shape[2:])
            # Stride 16 predicts its flow again, it does not refine that of stride 32.
            estimate, context = self.embedding_decoder(stride, posterior, features, context)
        return self.correct(estimate, first, second, STRIDES[-1])

    def correct(
        self, estimate: WarpEstimate, query: Pyramid, support: Pyramid, stride: int
    ) -> WarpEstimate:
        refiner = self.conv_refiner[str(stride)]
        corrections = refiner(query.at(stride), support.at(stride), estimate.flow)
        return refined(estimate, corrections, stride, query.at(1).shape[2:])


class EmbeddingDecoder(nn.Module):
    """A decoder of the posterior into a first estimate, with a context for the next scale."""

    def __init__(self) -> None:
        super().__init__()
        self.feat_input_modules = nn.ModuleDict()
        self.rrb_d = nn.ModuleDict()
        self.cab = nn.ModuleDict()
        self.rrb_u = nn.ModuleDict()
        self.terminal_module = nn.ModuleDict()
        for stride in STRIDES:
            at = str(stride)
            self.feat_input_modules[at] = nn.Conv2d(FEATURES, POSTERIOR, 1)
            self.rrb_d[at] = ResidualRefinement(2 * POSTERIOR)
            self.cab[at] = ChannelAttention()
            self.rrb_u[at] = ResidualRefinement(WIDTH)
            self.terminal_module[at] = ExactConv2d(WIDTH, 3, 1)

    def forward(
        self, stride: int, posterior: Tensor, features: Tensor, context: Tensor
    ) -> tuple[WarpEstimate, Tensor]:
        """Return the estimate of a stride and the next stride's context (B, 384, h, w).

        Inputs are the posterior (B, 256, h, w), features (B, 512, h, w) and the previous context.
        """
        at = str(stride)
        own = self.feat_input_modules[at](features)
        joined = torch.cat(
            [own, posterior.to(own.dtype)], dim=1
        )  # (B, 512, h, w), features first
        embedded = self.rrb_d[at](joined)
        context = self.rrb_u[at](self.cab[at](context, embedded))
        found = self.terminal_module[at](context.float())  # (B, 3, h, w): certainty, x, y
        return WarpEstimate(found[:, 1:], found[:, :1]), context


class ResidualRefinement(nn.Module):
    """Two 3x3 convolutions with a shortcut, after a 1x1 convolution that sets the width."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, WIDTH, 1)
        self.conv2 = nn.Conv2d(WIDTH, WIDTH, 3, padding=1)
        self.bn = nn.BatchNorm2d(WIDTH)
        self.conv3 = nn.Conv2d(WIDTH, WIDTH, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, inputs, h, w) to (B, 384, h, w)."""
        x = self.conv1(x)
        y = torch.relu_(self.bn(self.conv2(x)))
        return torch.relu_(self.conv3(y).add_(x))


class ChannelAttention(nn.Module):
    """Context plus embedding, weighted per channel by the spatial means of both maps."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(2 * WIDTH, WIDTH, 1)
        self.conv2 = nn.Conv2d(WIDTH, WIDTH, 1)

    def forward(self, context: Tensor, embedded: Tensor) -> Tensor:
        """Map two maps (B, 384, h, w) to (B, 384, h, w)."""
        both = torch.cat([context, embedded], dim=1)
        means = both.mean(dim=(2, 3), keepdim=True)  # (B, 768, 1, 1)
        weights = self.conv2(self.conv1(means).relu_()).sigmoid_()
        # The weights apply to the embedding only; the context is added as it is.
        return torch.addcmul(context, weights, embedded)


class Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolutions with a shortcut; a 1x1 convolution where the shape changes.

    Written here because offline installs have no torchvision. The 3x3 convolution has the stride.
    """

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
        """Map (B, inputs, h, w) to (B, 4 width, ceil(h / stride), ceil(w / stride))."""
        y = functional.relu_(self.bn1(self.conv1(x)))
        y = functional.relu_(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y))
        return functional.relu_(y.add_(self.downsample(x)))


def stage(inputs: int, width: int, blocks: int, stride: int) -> nn.Sequential:
    """Make a stage of ResNet-50; only its first block has the stride."""
    first = Bottleneck(inputs, width, stride)
    later = [Bottleneck(EXPANSION * width, width) for _ in range(blocks - 1)]
    return nn.Sequential(first, *later)


class ResNet50(nn.Module):
    """ResNet-50. The classifier is unused; it exists because checkpoints have it."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.layer1 = stage(64, 64, blocks=3, stride=1)
        self.layer2 = stage(256, 128, blocks=4, stride=2)
        self.layer3 = stage(512, 256, blocks=6, stride=2)
        self.layer4 = stage(1024, 512, blocks=3, stride=2)
        self.fc = nn.Linear(2048, 1000)

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """Return features at strides 2, 4, 8, 16 and 32 of images (B, 3, H, W) of any size.

        Features are (B, C, h, w) with C = 64, 256, 512, 1024, 2048; every halving of a side rounds
        up.
        """
        # Stride 2 is read before the max pool.
        levels = [functional.relu_(self.bn1(self.conv1(image)))]
        x = functional.max_pool2d(levels[0], 3, stride=2, padding=1)
        for layer in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = layer(x)
            levels.append(x)
        return tuple(levels)
