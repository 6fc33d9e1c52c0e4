"""Matches drawn evenly from a dense warp: Edstedt et al. 2023, "DKM", section 3.5."""

import torch
from torch import Generator, Tensor

OVERSAMPLING = 4  # the factor before matches are balanced
BANDWIDTH = 0.1  # of the density's kernel, in normalised coordinates
MIN_DENSITY, LAST_RESORT = 10, 1e-7  # isolated matches are drawn only if no others remain
BLOCK_FLOATS = 2**20
MIN_EXPONENT = -80  # exp of less is denormal: ten times slower, and adds nothing


def sample_matches(
    warp: Tensor, certainty: Tensor, number: int, threshold: float, generator: Generator
) -> Tensor:
    """Return indices (M,) int64 of up to ``number`` matches, drawn from a warp (N, 4) by finite
    certainty (N,).

    Certainties above ``threshold`` count as 1. Matches of certainty 0 are never drawn.
    ``generator``, on the tensors' device, is the source of randomness.
    """
    weights = certainty.masked_fill(certainty > threshold, 1)
    index = draw(
        weights, torch.empty_like(weights).exponential_(generator=generator), number * OVERSAMPLING
    )
    evenness = balancing_weights(density(warp[index]))
    return index[
        draw(evenness, torch.empty_like(evenness).exponential_(generator=generator), number)
    ]


def draw(weights: Tensor, noise: Tensor, number: int) -> Tensor:
    """Draw up to ``number`` distinct indices (M,) int64 of weights (N,), none of weight 0.

    Sorting by weight / noise, with exponential noise (N,), equals successive draws in proportion to
    weight.
    """
    drawn = (weights / noise).topk(min(number, len(weights))).indices
    return drawn[weights[drawn] > 0]


def density(points: Tensor) -> Tensor:
    """Return (N,) sums of exp(-|p - q|^2 / (2 bandwidth^2)) over all points q, for each point p of
    (N, D).
    """
    density = points.new_empty(len(points))
    rows = max(1, BLOCK_FLOATS // max(1, len(points)))
    for some, out in zip(torch.split(points, rows), torch.split(density, rows), strict=True):
        exponents = torch.cdist(some, points).square_().div_(-2 * BANDWIDTH**2)
        torch.sum(exponents.clamp_(min=MIN_EXPONENT).exp_(), dim=1, out=out)
    return density


def balancing_weights(density: Tensor) -> Tensor:
    """Map densities (N,) to weights (N,): lower for higher densities, and almost 0 for isolated
    points.
    """
    return (1 / (density + 1)).masked_fill_(density < MIN_DENSITY, LAST_RESORT)
