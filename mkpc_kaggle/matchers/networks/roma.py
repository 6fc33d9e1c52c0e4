"""RoMa, a dense matcher with features of DINOv2 and VGG-19.

Source: Edstedt et al., "RoMa: Robust Dense Feature Matching", CVPR 2024.

DKM with other features. The coarse features are DINOv2's, one per patch of 14 x 14 pixels.
Checkpoints name this stride 16; displacements count a patch as 16 pixels. The two images may differ
in size. Coordinates are normalised: (x, y) in [-1, 1], where +-1 are the outer edges of an image
(see warp_refiner). Parameter names match the public checkpoints, DINOv2's under the prefix
"dinov2.". For inference only.
"""

from collections.abc import Sequence
from math import sqrt

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.networks.dense_warp import (
    DenseFeatures,
    DenseNetwork,
    GaussianProcess,
    Pyramid,
    WarpDecoder,
    tokens,
)
from mkpc_kaggle.matchers.networks.dinov2 import DinoV2, VitBlock
from mkpc_kaggle.matchers.networks.grids import as_grid, as_map, pointwise
from mkpc_kaggle.matchers.networks.layers import ExactLinear
from mkpc_kaggle.matchers.networks.vgg import VGG19, WIDTHS, Vgg
from mkpc_kaggle.matchers.networks.warp_refiner import (
    SHAPES,
    WarpEstimate,
    WarpRefiner,
    WarpRefinerShape,
    identity_map,
    refined,
)

COARSEST = 16
# DKM's, except for the last one: RoMa compares 9 projected channels, DKM the colours.
REFINERS = SHAPES | {1: WarpRefinerShape(9, 6, None, 24)}
DISPLACEMENT = 1.25  # the factor of displacements in a square image of the trained side
TRAINED_SIDE = 560  # pixels

# The coarse decoder.
SIDE = 64  # of the grid of anchors, for any image shape
BLOCKS = 5
HEADS = 8
EPSILON = 1e-5  # of its norms; DINOv2's have another


class RoMa(DenseNetwork):
    """RoMa, trained at 560 x 560, with a second pass at 864 x 864."""

    def __init__(self) -> None:
        super().__init__()
        self.dinov2 = DinoV2()
        self.encoder = nn.ModuleDict({"cnn": Vgg(VGG19)})
        self.decoder: RomaDecoder = RomaDecoder(self.dinov2.norm.weight.numel())
        self.eval().requires_grad_(False)

    def encode(self, image: Tensor, fine: Tensor | None = None) -> DenseFeatures:
        """Encode images with sides that are multiples of 14; sides of ``fine`` are at least 8."""
        vgg = self.encoder["cnn"]
        coarse = self.decoder.projected([*vgg(image), self.dinov2(image)])
        coefficients = self.decoder.process.regress(coarse.at(COARSEST))
        # The second pass starts at stride 8 and needs no features of DINOv2.
        second = None if fine is None else self.decoder.projected(vgg(fine))
        return DenseFeatures(coarse, (coefficients,), second)


class RomaDecoder(WarpDecoder):
    def __init__(self, coarse_features: int) -> None:
        super().__init__()
        width = REFINERS[COARSEST].features
        strides = (1, 2, 4, 8, COARSEST)
        inputs = dict(zip(strides, (*WIDTHS, coarse_features), strict=True))
        self.embedding_decoder = AnchorDecoder(2 * width)
        self.gps = nn.ModuleDict({str(COARSEST): GaussianProcess(width)})
        self.proj = nn.ModuleDict()
        self.conv_refiner = nn.ModuleDict()
        for stride, shape in REFINERS.items():
            self.proj[str(stride)] = Projection(inputs[stride], shape.features)
            self.conv_refiner[str(stride)] = WarpRefiner(shape)

    def projected(self, levels: Sequence[Tensor]) -> Pyramid:
        """Return features at strides 1, 2, 4, ..., projected to the decoder's channels."""
        projected = []
        for power, features in enumerate(levels):
            projection = self.proj[str(2**power)]
            projected.append(projection(features))
        return Pyramid(tuple(projected))

    @property
    def process(self) -> GaussianProcess:
        process = self.gps[str(COARSEST)]
        assert isinstance(process, GaussianProcess)
        return process

    def coarse_estimate(self, query: DenseFeatures, support: DenseFeatures) -> WarpEstimate:
        features = query.coarse.at(COARSEST)
        (coefficients,) = support.coefficients
        posterior = self.process(features, support.coarse.at(COARSEST), coefficients)
        first = self.embedding_decoder(posterior, features)
        return self.correct(first, query.coarse, support.coarse, COARSEST)

    def correct(
        self, estimate: WarpEstimate, query: Pyramid, support: Pyramid, stride: int
    ) -> WarpEstimate:
        size = query.at(1).shape[2:]
        refiner = self.conv_refiner[str(stride)]
        first = query.at(stride)
        second = support.at(stride)
        corrections = refiner(first, second, estimate.flow, stretch(size))
        # In this network the certainty's correction comes last, in DKM first.
        return refined(estimate, corrections.roll(1, dims=1), stride, size)


class Projection(nn.Sequential):
    """A projection to the channels that the decoder compares."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(nn.Conv2d(inputs, outputs, 1), nn.BatchNorm2d(outputs))

    def forward(self, features: Tensor) -> Tensor:
        """Map (B, C, h, w) to (B, C', h, w), both channels last."""
        mix, norm = self
        assert isinstance(mix, nn.Conv2d)
        grid = as_grid(features.to(mix.weight.dtype))
        projected: Tensor = norm(as_map(pointwise(mix, grid)))
        return projected


def stretch(size: torch.Size) -> float:
    """Return the factor of displacements for an image (H, W): one scale in pixels at any size."""
    return DISPLACEMENT * sqrt(size.numel()) / TRAINED_SIDE


class AnchorDecoder(nn.Module):
    """A transformer without positional encoding, because the posterior contains positions."""

    def __init__(self, width: int) -> None:
        super().__init__()
        blocks = (
            VitBlock(width, HEADS, EPSILON, bias=False, scaled=False) for _ in range(BLOCKS)
        )
        self.blocks = nn.ModuleList(blocks)
        self.to_out = ExactLinear(width, SIDE**2 + 1)

    def forward(self, posterior: Tensor, features: Tensor) -> WarpEstimate:
        """Return the first estimate from a posterior (B, C, h, w) and features (B, C', h, w).

        C + C' is the decoder's width.
        """
        x = torch.cat([tokens(posterior), tokens(features)], dim=2)  # (B, h w, C + C')
        for block in self.blocks:
            x = block(x)
        logits = self.to_out(x)  # (B, h w, 4097): the anchors, then the certainty
        flow = anchor_mean(logits[..., :-1])  # (B, h w, 2)
        certainty = logits[..., -1:]  # (B, h w, 1)
        size = posterior.shape[2:]
        return WarpEstimate(
            flow.mT.reshape(len(x), -1, *size),
            certainty.mT.reshape(len(x), -1, *size),
        )


def anchor_mean(logits: Tensor) -> Tensor:
    """Map logits (..., 4096) to the mean position (..., 2) of the best anchor and its neighbours.

    Anchors are weighted by probability. As in training, neighbours are 1 or 64 indices away, also
    across the ends of rows; indices are clamped to the first and last anchor.
    """
    best = logits.argmax(dim=-1, keepdim=True)
    offsets = torch.tensor([-1, 0, 1, -SIDE, SIDE], device=logits.device)
    # At the ends of the grid an anchor may be counted twice or three times, as in training.
    near = (best + offsets).clamp(0, SIDE**2 - 1)  # (..., 5)
    anchors = as_grid(identity_map(logits.new_empty(SIDE, SIDE))).reshape(-1, 2)  # (4096, 2)
    # The softmax over five equals that over all anchors, divided by the five's sum.
    shares = logits.gather(-1, near).softmax(dim=-1)
    return (shares[..., None] * anchors[near]).sum(dim=-2)
