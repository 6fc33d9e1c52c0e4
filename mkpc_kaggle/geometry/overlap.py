"""Do two images show the same thing? The matches that agree with their F, against those that chance makes agree.

The number of inliers does not tell: among thousands of wrong matches hundreds agree with some F. What chance makes
agree is counted on the same points, at the same density: each point of image 0 is given the partner of another.
"""

import numpy as np

from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import DistinctMatches, homogeneous
from mkpc_kaggle.geometry.two_view import sampson

AGREEMENT_PX = 1.0  # Sampson distance within which a match agrees with F
FREE_MATCHES = 7  # which agree with an F that is made of them, whatever they are
MAX_SHUFFLES, SHUFFLED_MATCHES = 20, 20_000  # how often partners are exchanged: fewer times where matches are many
MIN_SUPPORT = 20.0  # fewer than 1 in 100 pairs without overlap have it; docs/results.md has the table of errors


def support(F: Matrix3, matches: Matches) -> float:
    """How many times as many matches (image pixels) agree with F as chance makes agree; below 0 never.

    Duplicates count once. From ``MIN_SUPPORT`` on, the two images most likely show the same thing.
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
