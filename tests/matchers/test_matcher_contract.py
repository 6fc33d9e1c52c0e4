"""The contract of every matcher, with stand-in weights."""

import numpy as np
import pictures
import pytest
import torch
from light_matchers import MATCHERS
from pictures import same
from torch.nn import functional

from mkpc_kaggle.matchers.contract import (
    Colour,
    NonFiniteError,
    Placement,
    arrays_of,
    encoding_bytes,
)
from mkpc_kaggle.matchers.dtypes import check_finite

# Odd sides, a wide strip, and a picture of one column.
SIZES = [
    ((33, 47), (64, 48)),
    ((9, 120), (40, 40)),
    ((20, 1), (40, 50)),
]


@pytest.fixture(params=MATCHERS, scope="module")
def matcher(request):
    return MATCHERS[request.param](Placement())


def picture(matcher, height, width, name="scene"):
    spec = matcher.spec
    channels = 1 if spec.colour is Colour.GRAY else 3
    return pictures.picture(height, width, name, channels=channels, multiple=spec.multiple)


@pytest.mark.parametrize("sizes", SIZES)
def test_matches_lie_on_pictures_of_any_size(matcher, sizes):
    shown = [picture(matcher, *size, f"{size}") for size in sizes]
    encodings = [matcher.encode([each])[0] for each in shown]
    (matches,) = matcher.match(encodings[:1], encodings[1:])
    # A lossless copy for the store, which keeps float32.
    for part in (matches.points0, matches.points1, matches.scores):
        assert part.dtype == np.float32
    assert (matches.scores >= 0).all()
    assert (matches.scores <= 1.0001).all()
    both = (matches.points0, matches.points1)
    # A window may reach over the edge by a few pixels.
    for points, (height, width) in zip(both, sizes, strict=True):
        assert (points > -5).all()
        assert (points < np.array([width, height]) + 4).all()
    views = [each.view for each in shown]
    assert len(matches.to_image(*views)) >= 0.8 * len(matches)


def test_the_same_pair_gives_the_same_bytes_after_other_pairs(matcher):
    shown = [picture(matcher, 64, 96, name) for name in ("scene", "scene", "another")]
    encodings = [matcher.encode([each])[0] for each in shown]
    (alone,) = matcher.match(encodings[:1], encodings[1:2])
    # A matcher that draws from torch's global generator would now draw other numbers.
    torch.rand(5)
    (other,) = matcher.match(encodings[2:], encodings[1:2])
    (again,) = matcher.match(encodings[:1], encodings[1:2])
    assert len(alone) > 5
    assert same(alone, again)
    assert not same(alone, other)


def test_an_encoding_keeps_only_counted_memory_and_no_pairs_give_no_matches(matcher):
    pictures_of_a_batch = [picture(matcher, 64, 96, name) for name in ("scene", "another")]
    for encoding in matcher.encode(pictures_of_a_batch):
        # A view of the whole batch's tensor would keep all of it, and the cache would count a part.
        kept = sum(tensor.untyped_storage().nbytes() for tensor in arrays_of(encoding))
        assert encoding_bytes({"encoding": encoding}) == kept > 0
    assert list(matcher.match([], [])) == []


def overflow(monkeypatch):
    """Let all linear maps and convolutions overflow from now on, as in half precision they may."""

    def infinite(exact):
        return lambda *args, **more: exact(*args, **more) * torch.inf

    for name in ("linear", "conv1d", "conv2d"):
        exact = getattr(functional, name)
        monkeypatch.setattr(functional, name, infinite(exact))


def test_overflow_is_an_error_and_never_a_lack_of_keypoints_or_matches(matcher, monkeypatch):
    encodings = [
        matcher.encode([picture(matcher, 64, 96, name)]) for name in ("scene", "another")
    ]
    overflow(monkeypatch)
    if matcher.spec.name != "sift_lightglue":  # SIFT is no network
        shown = picture(matcher, 64, 96)
        with pytest.raises(NonFiniteError):
            check_finite("features", list(matcher.encode([shown])))
    if matcher.spec.name != "aliked":  # nearest neighbours need no network
        with pytest.raises(NonFiniteError):
            matcher.match(*encodings)
