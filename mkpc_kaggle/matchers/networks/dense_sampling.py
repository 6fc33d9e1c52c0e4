"""Matches drawn evenly from a dense warp: Edstedt et al. 2023, "DKM", section 3.5."""

import torch
from torch import Generator, Tensor

OVERSAMPLING = 4  # the factor before matches are balanced
BANDWIDTH = 0.1  # of the density's kernel, in normalised coordinates
# Published: a match of a lower density is drawn only if no others remain.
MIN_DENSITY = 10
LAST_RESORT = 1e-7  # the weight of these matches
# Of all-pairs distances, which would be 6.4 GB for 10,000 matches: 4 MiB on a CPU, 256 MiB on a GPU. It
# is idle between small blocks: 20,000 points would have 385 of them.
BLOCK_FLOATS = {"cpu": 2**20, "cuda": 2**26}
MIN_EXPONENT = -80  # exp of less is denormal: ten times slower, and adds nothing


def sample_matches(
    warp: Tensor, certainty: Tensor, number: int, threshold: float, generator: Generator
) -> Tensor:
    """Draw up to ``number`` matches from a warp (N, 4) by finite certainty (N,); return indices.

    Indices are (M,) int64. Certainties above ``threshold`` count as 1. Matches of certainty 0 are
    never drawn. ``generator``, on the tensors' device, is the source of randomness.
    """
    weights = certainty.masked_fill(certainty > threshold, 1)
    # The noise of both draws is drawn in this order, as in the published code: the golden vectors
    # have it.
    noise = torch.empty_like(weights).exponential_(generator=generator)
    index = draw(weights, noise, number * OVERSAMPLING)

    evenness = balancing_weights(density(warp[index]))
    noise = torch.empty_like(evenness).exponential_(generator=generator)
    return index[draw(evenness, noise, number)]


def draw(weights: Tensor, noise: Tensor, number: int) -> Tensor:
    """Draw up to ``number`` distinct indices (M,) int64 of weights (N,), none of weight 0.

    Sorting by weight / noise, with exponential noise (N,), equals successive draws in proportion to
    weight.
    """
    drawn = (weights / noise).topk(min(number, len(weights))).indices
    return drawn[weights[drawn] > 0]


def density(points: Tensor) -> Tensor:
    """Return a kernel density (N,) at each of the points (N, D).

    It is the sum of exp(-|p - q|^2 / (2 bandwidth^2)) over all points q, p itself included.
    """
    density = points.new_empty(len(points))
    floats = BLOCK_FLOATS.get(points.device.type, 2**20)
    rows = max(1, floats // max(1, len(points)))
    # The parts of ``density`` are views, which each block fills.
    parts = torch.split(density, rows)
    for some, out in zip(torch.split(points, rows), parts, strict=True):
        exponents = torch.cdist(some, points).square_().div_(-2 * BANDWIDTH**2)
        torch.sum(exponents.clamp_(min=MIN_EXPONENT).exp_(), dim=1, out=out)
    return density


def balancing_weights(density: Tensor) -> Tensor:
    """Map densities (N,) to weights (N,): low for high densities, almost 0 for isolated points."""
    weights = 1 / (density + 1)
    return weights.masked_fill_(density < MIN_DENSITY, LAST_RESORT)
