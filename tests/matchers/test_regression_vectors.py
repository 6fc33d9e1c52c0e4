"""Matches of whole matchers against stored vectors, which need no golden files.

Weights and pictures come from ``standin.py`` alone, so nothing but the code decides the numbers.
``PYTHONPATH=.:tests/support python tests/matchers/test_regression_vectors.py`` writes ``matches.npz`` again. Do so
only for an intended change, and only while the parity tests pass.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from light_matchers import MATCHERS, SHIFT, picture
from pictures import agreement

from mkpc_kaggle.matchers.contract import Placement

DATA = Path(__file__).parent / "matches.npz"
# SIFT differs between versions of OpenCV
NAMES = [name for name in MATCHERS if name != "sift_lightglue"]
# Of the matches: a threshold or a tie within rounding may fall the other way on another processor
SAME = 0.95
# Pair, pixels, score; a row is within all of them
TOLERANCES = np.array([0.5, *4 * [0.05], 2e-3])


def found(name):
    """The matches (M, 6) of two pairs: number of the pair, points, score."""
    matcher = MATCHERS[name](Placement())
    encodings = []
    for shift in (SHIFT, 0):
        side = [picture(matcher.spec.colour, number, shift) for number in (0, 1)]
        encodings.append([matcher.encode([shown])[0] for shown in side])
    rows = []
    for pair, matches in enumerate(matcher.match(*encodings)):
        number = np.full(len(matches), pair)
        rows.append(
            np.column_stack([number, matches.points0, matches.points1, matches.scores])
        )
    return np.concatenate(rows)


@pytest.mark.parametrize("name", NAMES)
def test_matches_equal_the_regression_vectors(name):
    with np.load(DATA) as file:
        stored = file[name]
    assert len(stored) > 20
    both = (torch.from_numpy(matches / TOLERANCES) for matches in (found(name), stored))
    assert agreement(*both, 1, torch.inf) >= SAME


if __name__ == "__main__":
    torch.set_num_threads(1)
    DATA.parent.mkdir(exist_ok=True)
    np.savez_compressed(DATA, **{name: found(name) for name in NAMES})
