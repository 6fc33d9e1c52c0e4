"""What the contract asks of every matcher, with stand-in weights."""

import numpy as np
import pytest
import torch
from light_matchers import MATCHERS
from standin import scene

from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.matchers.contract import Colour, Picture, Placement, arrays_of, encoding_bytes
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
from mkpc_kaggle.recipe import Recipe, Unit

pytestmark = pytest.mark.filterwarnings("ignore:.*is not verified")
SIZES = [((33, 47), (64, 48)), ((9, 120), (40, 40)), ((20, 1), (40, 50))]


@pytest.fixture(params=MATCHERS, scope="module")
def matcher(request):
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield MATCHERS[request.param](Placement())
    torch.set_num_threads(before)


def picture(matcher, height, width, name="scene", padding=0):
    """One to one, with at least that padding."""
    content, multiple = Size(width, height), matcher.spec.multiple
    padded = Size(*(-(-(side + padding) // multiple) * multiple for side in content))
    pixels = scene(height, width, 1 if matcher.spec.colour is Colour.GRAY else 3, name)
    view = View(Box.whole(content), content, padded)
    return Picture(view.render(pixels[..., 0] if matcher.spec.colour is Colour.GRAY else pixels), view)


def same(first, second):
    parts = ("points0", "points1", "scores")
    return all(getattr(first, part).tobytes() == getattr(second, part).tobytes() for part in parts)


@pytest.mark.parametrize("sizes", SIZES)
def test_matches_lie_on_the_pictures_whatever_their_sizes(matcher, sizes):
    pictures = [picture(matcher, *size, f"{size}") for size in sizes]
    encodings = [matcher.encode([each])[0] for each in pictures]
    (matches,) = matcher.match(encodings[:1], encodings[1:])
    assert all(part.dtype == np.float32 for part in (matches.points0, matches.points1, matches.scores))
    assert ((matches.scores >= 0) & (matches.scores <= 1.0001)).all()
    # A window or a keypoint's subpixel offset may reach over the edge by a few pixels.
    for points, size in zip((matches.points0, matches.points1), sizes, strict=True):
        assert (points > -5).all() and (points < np.array(size[::-1]) + 4).all()
    views = [each.view for each in pictures]
    assert len(matches.to_image(*views)) >= 0.8 * len(matches)


def test_the_same_pair_gives_the_same_bytes_whatever_ran_before(matcher):
    pictures = [picture(matcher, 64, 96, name) for name in ("scene", "scene", "another")]
    encodings = [matcher.encode([each])[0] for each in pictures]
    (alone,) = matcher.match(encodings[:1], encodings[1:2])
    torch.rand(5)
    other = matcher.match(encodings[2:], encodings[1:2])[0]
    (again,) = matcher.match(encodings[:1], encodings[1:2])
    assert len(alone) > 5
    assert same(alone, again)
    assert not same(alone, other)


def test_an_encoding_has_memory_of_its_own_and_all_of_it_is_counted(matcher):
    encodings = matcher.encode([picture(matcher, 64, 96, name) for name in ("scene", "another")])
    for encoding in encodings:
        assert encoding_bytes(encoding) == sum(array.nbytes for array in arrays_of(encoding)) > 0


def test_nothing_gives_nothing(matcher):
    assert list(matcher.encode([])) == []
    assert list(matcher.match([], [])) == []


def test_both_stages_run_with_odd_flat_and_tiny_pictures(matcher):
    name = matcher.spec.name
    run = TwoStageMatcher(Recipe((Unit(1, name, 96), Unit(2, name, 64))), matchers={name: matcher})
    for pixels in (np.full((60, 80, 3), 128, np.uint8), scene(33, 47, 3)):
        found = run(pixels, scene(90, 70, 3))
        assert [result.failure for result in found.results] == ["", ""]
        assert np.isfinite(found.estimate.matrix).all()
