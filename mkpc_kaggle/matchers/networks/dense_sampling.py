"""Draws matches from a dense warp, spread evenly over the images: Edstedt et al. 2023, "DKM", section 3.5."""

from dataclasses import dataclass
from enum import StrEnum

import torch
from torch import Generator, Tensor

OVERSAMPLING = 4  # before matches are balanced
BANDWIDTH = 0.1  # of the density's kernel, in normalised coordinates
MIN_DENSITY, LAST_RESORT = 10, 1e-7  # isolated matches are drawn only when no others are left
BLOCK_FLOATS = 2**20
LEAST_EXPONENT = -80  # e to less is denormal, which takes a processor ten times as long and adds nothing


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
