"""Matches of whole matchers against vectors of our own, which need no golden files; mistakes must show in them.

Weights and pictures come from ``standin.py`` alone, so nothing but the code decides the numbers.
``PYTHONPATH=.:tests/support python tests/matchers/test_regression_vectors.py`` writes ``matches.npz`` anew.
That is right only when a change is wanted, and only while the parity tests pass: they say what the numbers
should be.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from light_matchers import MATCHERS, SHIFT, picture
from pictures import agreement
from torch.nn import functional

from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.networks import warp_refiner
from mkpc_kaggle.matchers.networks.grids import as_grid

DATA = Path(__file__).parent / "matches.npz"
NAMES = [name for name in MATCHERS if name != "sift_lightglue"]  # SIFT differs between versions of OpenCV
SAME = 0.95  # of the matches: a threshold or a tie within rounding may fall the other way on another processor
TOLERANCES = np.array([0.5, *4 * [0.05], 2e-3])  # pair, pixels, score; a row is within all of them


def found(name):
    """The matches (M, 6) of two pairs: number of the pair, points, score."""
    matcher = MATCHERS[name](Placement())
    sides = [[picture(matcher.spec.colour, number, shift) for number in (0, 1)] for shift in (SHIFT, 0)]
    encodings = [[matcher.encode([shown])[0] for shown in side] for side in sides]
    return np.concatenate(
        [
            np.column_stack([np.full(len(matches), pair), matches.points0, matches.points1, matches.scores])
            for pair, matches in enumerate(matcher.match(*encodings))
        ]
    )


def agreement_with_vectors(name):
    """The share of the matches, found or stored, that have a partner in the others within the tolerances."""
    with np.load(DATA) as file:
        stored = file[name]
    assert len(stored) > 20
    return agreement(*(torch.from_numpy(matches / TOLERANCES) for matches in (found(name), stored)), 1, torch.inf)


@pytest.mark.parametrize("name", NAMES)
def test_matches_are_those_of_the_vectors(name):
    assert agreement_with_vectors(name) >= SAME


def best_anchor(logits):
    grid = as_grid(warp_refiner.identity_map(logits.new_empty(64, 64))).reshape(-1, 2)
    return grid[logits.argmax(dim=-1)]


def nearest(x, size):
    return functional.interpolate(x, tuple(size))


MISTAKES = [  # one in a matcher of each kind: what is changed in its networks, and how
    ("roma", "roma.anchor_mean", best_anchor),
    ("dkm", "dense_warp.resize", nearest),
    ("loma", "loma_matcher.apply_rotary", lambda x, rotation: x),
    ("aliked", "aliked.TEMPERATURE", 0.2),
    ("superglue", "superglue.normalise_points", lambda points, size: points / max(size)),
    ("loftr", "fine_matching.CENTRE", 11),
    ("quadtree", "coarse_matching.inner_cells", lambda mask, border: mask.flatten()),
    ("aspanformer", "aspanformer.RADIUS", 4.0),
]


@pytest.mark.parametrize(("name", "what", "value"), MISTAKES, ids=[f"{name} {what}" for name, what, _ in MISTAKES])
def test_a_mistake_is_noticed(name, what, value, monkeypatch):
    monkeypatch.setattr(f"mkpc_kaggle.matchers.networks.{what}", value)
    assert agreement_with_vectors(name) < SAME


if __name__ == "__main__":
    torch.set_num_threads(1)
    DATA.parent.mkdir(exist_ok=True)
    np.savez_compressed(DATA, **{name: found(name) for name in NAMES})
