"""Test whether two images overlap: compare the inliers of their F with the inliers of shuffled
matches.

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
MAX_SHUFFLES, SHUFFLED_MATCHES = 20, 20_000  # number of shuffles, and of shuffled matches in total
# Fewer than 1 in 100 pairs without overlap reach it; docs/results.md has the error rates
MIN_SUPPORT = 20.0


def support(F: Matrix3, matches: Matches) -> float:
    """Return the number of matches (image pixels) that agree with F, over the number expected by
    chance.

    Duplicates count once. At a ratio of ``MIN_SUPPORT`` or more, the two images probably overlap.
    """
    distinct = DistinctMatches.of(matches)
    rays0, rays1 = homogeneous(distinct.points0), homogeneous(distinct.points1)

    def agreeing(shift: int) -> int:
        return int((np.abs(sampson(F, rays0, np.roll(rays1, shift, axis=0))) < AGREEMENT_PX).sum())

    count = len(rays0)
    times = max(1, min(MAX_SHUFFLES, SHUFFLED_MATCHES // max(count, 1)))
    shifts = [max(1, round(count * number / (times + 1))) for number in range(1, times + 1)]
    by_chance = sum(map(agreeing, shifts)) / times if count > 1 else 0.0
    return max(0, agreeing(0) - FREE_MATCHES) / (by_chance + 1)
