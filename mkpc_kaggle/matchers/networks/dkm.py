"""DKM v3: Edstedt et al., "DKM: Dense Kernelized Feature Matching for Geometry Estimation", CVPR 2023.

Two views of a pair are compared whole; every pixel of each gets a place in the other, and a certainty. The views
may have any sizes; the published code wants one size of both, where the results are the same.
Coordinates are normalised: (x, y) in [-1, 1], where +-1 are the outer edges of an image (see dkm_refiner).
Parameter names are those of the public checkpoints. For inference only.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import torch
from torch import Generator, Tensor, nn

from mkpc_kaggle.matchers.networks.dkm_coarse import FEATURES, STRIDES, WIDTH, EmbeddingDecoder, GaussianProcess
from mkpc_kaggle.matchers.networks.dkm_refiner import (
    SHAPES,
    Estimate,
    Refiner,
    identity_map,
    refined,
    resize,
)
from mkpc_kaggle.matchers.networks.grids import as_grid
from mkpc_kaggle.matchers.networks.pixels import resized
from mkpc_kaggle.matchers.networks.resnet50 import ResNet50

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
FINE_COARSEST = 8  # the coarsest stride that the second pass looks at
OVERSAMPLING = 4  # before matches are balanced
BANDWIDTH = 0.1  # of the density's kernel, in normalised coordinates
MIN_DENSITY, LAST_RESORT = 10, 1e-7  # isolated matches are drawn only when no others are left
BLOCK_FLOATS = 2**20
LEAST_EXPONENT = -80  # e to less is denormal, which takes a processor ten times as long and adds nothing


@dataclass(frozen=True)
class DkmConfig:
    """``symmetric``: match both ways; else from the query to the support only."""

    symmetric: bool = True


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Of B images, (B, C, h, w) each, in the network's precision: at strides 1, 2, 4, 8 and maybe 16 and 32."""

    levels: tuple[Tensor, ...]

    def at(self, stride: int) -> Tensor:
        return self.levels[stride.bit_length() - 1]


@dataclass(frozen=True, eq=False)
class DkmFeatures:
    """What one image alone yields: for the first pass and, from a larger version of it, for the second."""

    coarse: Pyramid
    fine: Pyramid | None = None


@dataclass(frozen=True, eq=False)
class DenseWarp:
    """Of B pairs, float32: ``warp`` (B, H, W, 4), (x, y) in the first image and (x, y) in the second, in [-1, 1];
    ``certainty`` (B, H, W) in [0, 1], 0 where the target is outside. The grid is that of one of the images.
    """

    warp: Tensor
    certainty: Tensor


def network_input(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """RGB images (B, 3, H, W) uint8 on the CPU -> (B, 3, *size) float32, resized and normalised.

    The second pass needs the image itself resized anew.
    """
    mean, std = (torch.tensor(values)[:, None, None] for values in (MEAN, STD))
    return resized(pixels, size).sub_(mean).div_(std)


class DKM(nn.Module):
    """Trained at 540 x 720 (outdoor; second pass 864 x 1152) and 480 x 640 (indoor); worse far from it."""

    def __init__(self, config: DkmConfig | None = None) -> None:
        super().__init__()
        self.config = config or DkmConfig()
        self.encoder = Encoder()
        self.decoder = Decoder()
        # Weights that lie channels last make every map so; loading a checkpoint keeps it.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stubs
        self.eval().requires_grad_(False)

    def encode(self, image: Tensor, fine: Tensor | None = None) -> DkmFeatures:
        """Images (B, 3, H, W) as :func:`network_input` makes them, of any size, and for a second pass larger."""
        coarse = self.decoder.projected(self.encoder(image))
        return DkmFeatures(coarse, None if fine is None else self.encoder(fine, FINE_COARSEST))

    def match(self, first: DkmFeatures, second: DkmFeatures) -> tuple[DenseWarp, ...]:
        """B pairs, whose images may differ in size: the warp on the first image's grid, then that on the second's.

        One way there is the former alone. With a second pass where both images have features for it; ValueError
        where only one has.
        """
        if (first.fine is None) != (second.fine is None):
            raise ValueError("of a pair either both images or neither must have features for a second pass")
        forward = dense_warp(*self.decoder(first, second))
        if not self.config.symmetric:
            return (forward,)
        # One after the other: as one batch both directions would take twice the memory and no less time.
        return forward, swapped(dense_warp(*self.decoder(second, first)))


class Encoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.net = ResNet50()

    def forward(self, image: Tensor, coarsest: int = 32) -> Pyramid:
        """The image (B, 3, H, W) itself and its features at strides 2 to ``coarsest``."""
        image = image.contiguous(memory_format=torch.channels_last)
        features = self.net(image.to(self.net.conv1.weight.dtype), coarsest)
        return Pyramid((image, *features))


class Decoder(nn.Module):
    """From the features of two images to the flow from the one to the other."""

    def __init__(self) -> None:
        super().__init__()
        self.embedding_decoder = EmbeddingDecoder()
        self.gps = nn.ModuleDict({str(s): GaussianProcess() for s in STRIDES})
        self.proj = nn.ModuleDict({"16": nn.Conv2d(1024, FEATURES, 1), "32": nn.Conv2d(2048, FEATURES, 1)})
        self.conv_refiner = nn.ModuleDict({str(s): Refiner(shape) for s, shape in SHAPES.items()})

    def projected(self, pyramid: Pyramid) -> Pyramid:
        """The pyramid of all six strides, with 512 channels at 16 and 32."""
        *finer, at16, at32 = pyramid.levels
        return Pyramid((*finer, self.proj["16"](at16), self.proj["32"](at32)))

    def forward(self, query: DkmFeatures, support: DkmFeatures) -> tuple[Estimate, Tensor]:
        """The flow from query to support at stride 1 of the last pass, and the first pass's logits at 16."""
        estimate = self.coarse_estimate(query.coarse, support.coarse)
        logits = estimate.certainty
        estimate = self.refine(estimate, query.coarse, support.coarse)
        if query.fine is not None and support.fine is not None:
            estimate = self.refine(estimate, query.fine, support.fine)
        return estimate, logits

    def coarse_estimate(self, query: Pyramid, support: Pyramid) -> Estimate:
        """At stride 16, refined. Of what stride 32 found only the context is used."""
        batch, _, height, width = query.at(32).shape
        context = query.at(32).new_zeros(batch, WIDTH, height, width)
        for stride in STRIDES:
            features = query.at(stride)
            posterior = self.gps[str(stride)](features, support.at(stride))
            context = resize(context, _size(query, stride))
            estimate, context = self.embedding_decoder(stride, posterior, features, context)
        return self.correct(estimate, query, support, STRIDES[-1])

    def refine(self, estimate: Estimate, query: Pyramid, support: Pyramid) -> Estimate:
        """Down to stride 1 from an estimate of any size."""
        for stride in (8, 4, 2, 1):
            estimate = self.correct(estimate.resized(_size(query, stride)), query, support, stride)
        return estimate

    def correct(self, estimate: Estimate, query: Pyramid, support: Pyramid, stride: int) -> Estimate:
        corrections = self.conv_refiner[str(stride)](query.at(stride), support.at(stride), estimate.flow)
        return refined(estimate, corrections, stride, _size(support, 1))


def _size(pyramid: Pyramid, stride: int) -> torch.Size:
    return pyramid.at(stride).shape[2:]


def dense_warp(estimate: Estimate, coarse_logits: Tensor) -> DenseWarp:
    """One direction on the query's grid; ``coarse_logits`` (B, 1, h, w): those of stride 16, first pass."""
    flow, logits = estimate.flow, estimate.certainty
    # Half of the coarse evidence against a match is taken back.
    doubts = resize(coarse_logits, logits.shape[2:]).clamp(max=0)
    certainty = torch.sigmoid(logits - 0.5 * doubts)[:, 0]  # (B, H, W)
    outside = (flow.abs() > 1).any(dim=1)
    pixels = identity_map(flow).expand_as(flow)
    warp = torch.cat([as_grid(pixels), as_grid(flow.clamp(-1, 1))], dim=3)  # (B, H, W, 4)
    return DenseWarp(warp, certainty.masked_fill_(outside, 0))


def swapped(dense: DenseWarp) -> DenseWarp:
    """The same pairs of points, the other image's coordinates first."""
    return DenseWarp(torch.cat([dense.warp[..., 2:], dense.warp[..., :2]], dim=3), dense.certainty)


def side_by_side(warps: Sequence[DenseWarp]) -> DenseWarp:
    """The published layout (B, H, 2 W, 4) of both directions, for images of one size."""
    return DenseWarp(
        torch.cat([dense.warp for dense in warps], dim=2), torch.cat([dense.certainty for dense in warps], dim=2)
    )


class Weighting(StrEnum):
    """What the certainty is taken for: see :func:`weights_of`."""

    THRESHOLD = "threshold"
    CUBE_ROOT = "cube root"
    UNIFORM = "uniform"
    PLAIN = "plain"


@dataclass(frozen=True)
class SamplingConfig:
    """As published. ``number``: how many matches at most. ``balanced``: spread evenly over the images."""

    number: int = 5000
    weighting: Weighting = Weighting.THRESHOLD
    threshold: float = 0.05
    balanced: bool = True

    def __post_init__(self) -> None:
        if self.number < 1:
            raise ValueError(f"number must be at least 1, not {self.number}")


@dataclass(frozen=True, eq=False)
class SampledMatches:
    """``matches`` (M, 4) float32, normalised (x, y) in either image; ``certainty`` (M,), as it was weighted;
    ``index`` (M,) int64, where they stand in the warp laid flat.
    """

    matches: Tensor
    certainty: Tensor
    index: Tensor


def sample(
    warp: Tensor, certainty: Tensor, config: SamplingConfig, generator: Generator | None = None
) -> SampledMatches:
    """Draws from a warp (..., 4) with its certainty (...), all pairs of a batch in one pool.

    Fewer than ``config.number`` where fewer have any weight, none at all being legal; ValueError where a
    certainty is not finite. ``generator`` (on the tensors' device; else PyTorch's own) fixes the outcome, also
    that of ``torch.multinomial`` for the same draws.
    """
    matches, weights = warp.reshape(-1, 4), weights_of(certainty.reshape(-1), config)
    if not weights.isfinite().all():
        raise ValueError("certainties must be finite")
    index = draw(weights, noise_like(weights, generator), config.number * (OVERSAMPLING if config.balanced else 1))
    if config.balanced:
        evenness = balancing_weights(density(matches[index]))
        index = index[draw(evenness, noise_like(evenness, generator), config.number)]
    return SampledMatches(matches[index], weights[index], index)


def weights_of(certainty: Tensor, config: SamplingConfig) -> Tensor:
    match config.weighting:
        case Weighting.THRESHOLD:
            return certainty.masked_fill(certainty > config.threshold, 1)
        case Weighting.CUBE_ROOT:
            return certainty ** (1 / 3)
        case Weighting.UNIFORM:
            return torch.ones_like(certainty)
        case Weighting.PLAIN:
            return certainty


def noise_like(weights: Tensor, generator: Generator | None) -> Tensor:
    return torch.empty_like(weights).exponential_(generator=generator)


def draw(weights: Tensor, noise: Tensor, number: int) -> Tensor:
    """Indices (M,) int64 of at most ``number`` entries of weights (N,), none twice, none of weight 0.

    With exponential noise (N,) the order of weight / noise is one of successive draws in proportion to weight.
    """
    drawn = (weights / noise).topk(min(number, len(weights))).indices
    return drawn[weights[drawn] > 0]


def density(points: Tensor) -> Tensor:
    """Sum over all points (N, D), itself included, of exp(-|p - q|^2 / (2 bandwidth^2)): (N,)."""
    density = points.new_empty(len(points))
    rows = max(1, BLOCK_FLOATS // max(1, len(points)))
    for some, out in zip(torch.split(points, rows), torch.split(density, rows), strict=True):
        exponents = torch.cdist(some, points).square_().div_(-2 * BANDWIDTH**2)
        torch.sum(exponents.clamp_(min=LEAST_EXPONENT).exp_(), dim=1, out=out)
    return density


def balancing_weights(density: Tensor) -> Tensor:
    """(N,) -> (N,): the denser, the less, yet next to nothing for isolated points."""
    return (1 / (density + 1)).masked_fill_(density < MIN_DENSITY, LAST_RESORT)
