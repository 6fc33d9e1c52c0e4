"""A test of whether two images overlap: inliers of their F against inliers of shuffled matches.

The number of inliers alone proves nothing: among thousands of wrong matches, hundreds agree with
some F. Shuffling gives each point of image 0 the partner of another point. The inliers of shuffled
matches are the number expected by chance for the same points and density.
"""

import numpy as np

from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import DistinctMatches, homogeneous
from mkpc_kaggle.geometry.two_view import sampson

AGREEMENT_PX = 1.0  # maximum Sampson distance of a match that agrees with F
FREE_MATCHES = 7  # F has seven degrees of freedom, so it can fit any seven matches
MAX_SHUFFLES = 20
SHUFFLED_MATCHES = 20_000  # of all shuffles: a pair with many matches needs fewer shuffles
# Fewer than 1 in 100 pairs without overlap reach it; docs/results.md has the error rates.
MIN_SUPPORT = 20.0


def support(F: Matrix3, matches: Matches) -> float:
    """Return the number of matches that agree with F, over the number expected by chance.

    Matches are in image pixels; duplicates count once. At a ratio of ``MIN_SUPPORT`` or more, the
    two images probably overlap.
    """
    distinct = DistinctMatches.of(matches)
    rays0 = homogeneous(distinct.points0)
    rays1 = homogeneous(distinct.points1)

    def agreeing(shift: int) -> int:
        """Count the matches that agree with F if image 1's points are shifted by ``shift``."""
        distances = np.abs(sampson(F, rays0, np.roll(rays1, shift, axis=0)))
        return int((distances < AGREEMENT_PX).sum())

    count = len(rays0)
    times = max(1, min(MAX_SHUFFLES, SHUFFLED_MATCHES // max(count, 1)))
    # Evenly spaced cyclic shifts instead of random permutations: the same input, the same result.
    shifts = []
    for number in range(1, times + 1):
        shifts.append(max(1, round(count * number / (times + 1))))
    by_chance = 0.0
    if count > 1:
        by_chance = sum(map(agreeing, shifts)) / times
    # One more in the denominator, so that a pair with few points by chance has no huge ratio.
    return max(0, agreeing(0) - FREE_MATCHES) / (by_chance + 1)
