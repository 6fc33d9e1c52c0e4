"""The two stages on pictures whose correspondence is known, with real matchers and with those that misbehave."""

import time
from collections import Counter
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.datasets import load_sample_image

from mkpc_kaggle.data.images import Image
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, Model, Origin
from mkpc_kaggle.matchers.contract import Colour, MatcherSpec
from mkpc_kaggle.matchers.sift import SiftMatcher, SiftOptions
from mkpc_kaggle.pipeline import units
from mkpc_kaggle.pipeline.pair import PairMatch, with_estimate
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
from mkpc_kaggle.recipe import Recipe, Unit

SIZE = Size(480, 360)
CORNER0, CORNER1, SCALE = (60, 130), (170, 50), 1.2
H = np.array(  # image 0 -> image 1, pixel centres at integers
    [
        [SCALE, 0, (0.5 - CORNER0[0]) * SCALE - 0.5 + CORNER1[0]],
        [0, SCALE, (0.5 - CORNER0[1]) * SCALE - 0.5 + CORNER1[1]],
        [0, 0, 1],
    ]
)
SIFT = Recipe((Unit(1, "sift", 480),))
TWO_STAGES = Recipe((Unit(1, "sift", 480), Unit(2, "sift", 440)))


pytestmark = pytest.mark.usefixtures("nowhere_else")


@cache
def pair():
    """Two gray canvases with the same photograph, 230 x 180 and ``SCALE`` times that, elsewhere on each."""
    photograph = load_sample_image("china.jpg")[20:380, 60:520]
    canvases = []
    for (left, top), scale in ((CORNER0, 1), (CORNER1, SCALE)):
        size = (round(230 * scale), round(180 * scale))
        canvas = np.full((SIZE.height, SIZE.width, 3), 128, np.uint8)
        shrunk = cv2.resize(photograph, size, interpolation=cv2.INTER_AREA)
        canvas[top : top + size[1], left : left + size[0]] = shrunk
        canvases.append(canvas)
    return tuple(canvases)


@cache
def two_stage_match():
    return TwoStageMatcher(TWO_STAGES)(*pair())


def errors(matches):
    true = cv2.perspectiveTransform(matches.points0[None].astype(np.float64), H)[0]
    return np.hypot(*(matches.points1 - true).T)


def same(first, second):
    return all(
        getattr(first, part).tobytes() == getattr(second, part).tobytes()
        for part in ("points0", "points1", "scores")
    )


# matchers of one's own


@dataclass(frozen=True)
class Nothing:
    """No options."""


def spec(name="own", **what):
    return MatcherSpec(name, "a test's", Nothing, **what)


@dataclass
class Features:
    points: np.ndarray
    descriptors: np.ndarray | None


class Orb:
    """OpenCV's ORB with brute force, as a user would plug it in."""

    spec = MatcherSpec("orb", "ORB", Nothing, Colour.GRAY)

    def __init__(self, features=500):
        self._orb = cv2.ORB_create(features)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)

    def encode(self, pictures):
        found = [self._orb.detectAndCompute(picture.pixels, None) for picture in pictures]
        return [Features(np.array([k.pt for k in ks], np.float32).reshape(-1, 2), ds) for ks, ds in found]

    def match(self, encodings0, encodings1):
        return [self._match(*pair) for pair in zip(encodings0, encodings1, strict=True)]

    def _match(self, one, two):
        if one.descriptors is None or two.descriptors is None:
            return Matches.empty()
        found = self._matcher.match(one.descriptors, two.descriptors)
        rows0, rows1 = [m.queryIdx for m in found], [m.trainIdx for m in found]
        return Matches(one.points[rows0], two.points[rows1], [-m.distance for m in found])


class Scripted:
    """Answers with the same matches always, or raises them; keeps the views it was shown."""

    def __init__(self, answer=None, **what):
        self.spec = spec(**what)
        self.answer = Matches.empty() if answer is None else answer
        self.shown = []

    def encode(self, pictures):
        self.shown += pictures
        return [np.zeros(3) for _ in pictures]

    def match(self, encodings0, encodings1):
        if isinstance(self.answer, Exception):
            raise self.answer
        return [self.answer for _ in encodings0]


class CountingSift(SiftMatcher):
    """Sift that counts how often each crop was encoded."""

    def __init__(self):
        super().__init__(SiftOptions(), "cpu")
        self.seen = Counter()

    def encode(self, pictures):
        self.seen.update(picture.view.crop for picture in pictures)
        return super().encode(pictures)


def own(*units, **matchers):
    return TwoStageMatcher(Recipe(units), matchers=matchers)


# from two pictures to a model


def test_both_stages_give_matches_in_full_image_pixels():
    match = two_stage_match()
    assert [result.unit for result in match.results] == list(TWO_STAGES.units)
    for result in match.results:
        assert len(result.matches) > 100
        assert np.median(errors(result.matches)) < 0.5
        assert np.mean(errors(result.matches) < 2) > 0.9


def test_the_critical_regions_are_where_the_photograph_is():
    for region, (left, top), scale in zip(two_stage_match().regions, (CORNER0, CORNER1), (1, SCALE), strict=True):
        assert region.cropped
        box, slack = region.box, 8 + 0.05 * 230 * scale
        assert abs(box.left - left) < slack
        assert abs(box.top - top) < slack
        assert abs(box.right - (left + 230 * scale)) < slack
        assert abs(box.bottom - (top + 180 * scale)) < slack


def test_the_second_stage_matches_lie_in_the_critical_regions():
    match = two_stage_match()
    region0, region1 = match.regions
    assert region0.box.contains(match.results[1].matches.points0).all()
    assert region1.box.contains(match.results[1].matches.points1).all()


def test_the_matches_of_all_units_follow_one_another_and_the_inliers_are_among_them():
    match = two_stage_match()
    assert same(match.matches, Matches.concatenate(result.matches for result in match.results))
    assert len(match.inliers) == match.estimate.inlier_count > 100
    assert match.estimate.ok
    assert all(result.failure == "" and result.seconds > 0 for result in match.results)


def test_matches_know_the_stage_that_found_them():
    match = two_stage_match()
    first, second = (result.matches for result in match.results)
    assert same(match.matches[match.in_stage(1)], first)
    assert same(match.matches[match.in_stage(2)], second)
    nothing = replace(match, results=())
    assert nothing.in_stage(1).shape == (0,)


def test_a_homography_comes_out_as_it_is():
    match = TwoStageMatcher(SIFT)(*pair(), model="H")
    assert match.estimate.model is Model.H
    found = match.estimate.matrix / match.estimate.matrix[2, 2]
    corners = np.array([[[60.0, 130], [290, 130], [290, 310], [60, 310]]])
    moved, true = (cv2.perspectiveTransform(corners, matrix) for matrix in (found, H))
    assert_allclose(moved, true, atol=0.7)


def test_an_essential_matrix_needs_the_cameras():
    K = np.array([[400.0, 0, 240], [0, 400, 180], [0, 0, 1]])
    matcher = TwoStageMatcher(SIFT)
    with pytest.raises(ValueError, match="intrinsics"):
        matcher(*pair(), model="E")
    E = matcher(*pair(), model=Model.E, intrinsics=(K, K)).estimate.matrix
    values = np.linalg.svd(E, compute_uv=False)
    assert_allclose(values / values[0], [1, 1, 0], atol=1e-6)


def test_a_prior_on_focal_lengths_goes_by_the_sizes_of_the_images_unless_the_cameras_are_known():
    prior = FocalConfig(sigma=1e-3)
    matcher = TwoStageMatcher(replace(SIFT, focal=prior))
    K = np.array([[400.0, 0, 240], [0, 400, 180], [0, 0, 1]])
    by_size = matcher(*pair()).estimate
    assert by_size.origin in (Origin.FROM_F, Origin.FROM_E)
    assert_allclose(by_size.focals, [prior.ratio * max(image.shape[:2]) for image in pair()], rtol=0.02)
    for model in (Model.F, Model.E):
        known = matcher(*pair(), model=model, intrinsics=(K, K)).estimate
        assert known.model is model
        assert_allclose(known.focals, 400)
    with pytest.raises(ValueError, match="E"):
        matcher(*pair(), model=Model.E)
    assert matcher(*pair(), model=Model.H).estimate.focals is None
    assert TwoStageMatcher(SIFT)(*pair()).estimate.focals is None


def test_the_same_pair_twice_gives_the_same_bytes():
    matcher = TwoStageMatcher(TWO_STAGES)
    first, second = matcher(*pair()), matcher(*pair())  # the second time from the cache
    assert same(first.matches, second.matches)
    assert same(first.matches, two_stage_match().matches)
    assert first.estimate.matrix.tobytes() == second.estimate.matrix.tobytes()


def test_paths_arrays_and_images_give_the_same(tmp_path):
    paths = []
    for number, pixels in enumerate(pair()):
        paths.append(tmp_path / f"{number}.png")
        cv2.imwrite(str(paths[-1]), pixels[..., ::-1])
    matcher = TwoStageMatcher(SIFT)
    expected = matcher(*pair()).matches
    assert same(matcher(*paths).matches, expected)
    assert same(matcher(*map(str, paths)).matches, expected)
    assert same(matcher(*map(Image.of_array, pair())).matches, expected)


def test_gray_arrays_are_matched_as_their_colour_twins():
    gray = [cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) for pixels in pair()]
    assert same(TwoStageMatcher(SIFT)(*gray).matches, TwoStageMatcher(SIFT)(*pair()).matches)


def test_an_array_of_another_type_is_refused():
    with pytest.raises(ValueError, match="float64"):
        TwoStageMatcher(SIFT)(pair()[0] / 255, pair()[1])


def test_an_image_that_cannot_be_read_is_refused_by_name(tmp_path):
    with pytest.raises(UserError, match=r"none\.png: no such file"):
        TwoStageMatcher(SIFT)(tmp_path / "none.png", pair()[1])


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (300, 1), (33, 47), (200, 200)])
def test_a_picture_with_nothing_in_it_is_a_result_with_a_reason(shape):
    match = TwoStageMatcher(TWO_STAGES)(np.full(shape, 99, np.uint8), pair()[1])
    assert not match.estimate.ok
    assert "too few" in match.estimate.failure
    assert_allclose(match.estimate.matrix, FALLBACK_FUNDAMENTAL / np.sqrt(2))
    assert [region.cropped for region in match.regions] == [False, False]


def test_at_most_so_many_matches_are_kept_and_they_are_the_surest():
    every = two_stage_match().results[0].matches
    some = TwoStageMatcher(Recipe((Unit(1, "sift", 480, max_matches=50),)))(*pair()).matches
    assert len(some) == 50
    assert same(some, every.best(50))
    assert some.scores.min() >= np.sort(every.scores)[-50]


def test_a_mirrored_unit_gives_points_of_the_image_that_is_not_mirrored():
    match = own(Unit(1, "sift", 480, flip=True))(*pair())
    assert len(match.matches) > 100
    assert np.median(errors(match.matches)) < 0.5
    assert Box(50, 120, 300, 320).contains(match.matches.points0).all()


# the order of things


def works(count=1):
    image0, image1 = map(Image.of_array, pair())
    smaller = Image.of_array(np.ascontiguousarray(pair()[1][:300, 100:]))
    return [PairMatch(images=(image0, other)) for other in (image1, smaller, image0)[:count]]


def pipeline(recipe, matcher=None, **what):
    matcher = matcher or SiftMatcher(SiftOptions(), "cpu")
    return Pipeline(recipe, lambda name: matcher, **what)


def test_results_are_in_the_order_of_the_recipe_whatever_was_run_first():
    recipe = Recipe((Unit(1, "sift", 480), Unit(2, "sift", 440), Unit(1, "sift", 360)))
    at_once = with_estimate(pipeline(recipe).match(works(), recipe.units)[0], recipe)
    runner, (work,) = pipeline(recipe), works()
    for unit in (recipe.units[2], recipe.units[0], recipe.units[1]):
        (work,) = runner.match([work], [unit])
    piecemeal = with_estimate(work, recipe)
    assert [result.unit for result in at_once.results] == list(recipe.units)
    assert [result.unit for result in piecemeal.results] == list(recipe.units)
    assert same(at_once.results[2].matches, piecemeal.results[2].matches)


def test_a_unit_that_a_pair_has_had_is_not_run_again():
    sift = CountingSift()
    runner = pipeline(TWO_STAGES, sift)
    done = runner.match(works(), TWO_STAGES.units)
    count = sift.seen.total()
    again = runner.match(done, TWO_STAGES.units)
    assert sift.seen.total() == count
    assert [result.unit for result in again[0].results] == list(TWO_STAGES.units)


def test_what_was_found_is_returned_when_there_is_no_going_on():
    (work,) = pipeline(TWO_STAGES).match(works(), TWO_STAGES.units, lambda unit: unit.stage == 1)
    assert [result.unit.stage for result in work.results] == [1]
    none = pipeline(TWO_STAGES).match(works(3), TWO_STAGES.units, lambda unit: False)
    assert [work.results for work in none] == [(), (), ()]
    assert with_estimate(none[0], TWO_STAGES).estimate.failure


def test_a_batch_gives_what_pairs_give_alone():
    alone, together = (pipeline(TWO_STAGES, batch=size).match(works(3), TWO_STAGES.units) for size in (1, 4))
    for one, other in zip(alone, together, strict=True):
        assert one.regions == other.regions
        assert all(same(a.matches, b.matches) for a, b in zip(one.results, other.results, strict=True))


def test_whole_images_are_encoded_once_and_crops_for_each_pair():
    sift = CountingSift()
    image0, image1 = works()[0].images
    first = PairMatch(images=(image0, image1))
    pipeline(TWO_STAGES, sift).match([first, PairMatch(images=(image1, image0)), first], TWO_STAGES.units)
    assert sift.seen.pop(Box.whole(SIZE)) == 2
    assert len(sift.seen) >= 2
    assert sift.seen.total() == 6


def test_matchers_see_gray_or_colour_and_multiples_as_they_ask():
    for colour, depth in ((Colour.GRAY, ()), (Colour.RGB, (3,))):
        matcher = Scripted(colour=colour, multiple=8)
        own(Unit(1, "own", 100), own=matcher)(*pair())
        assert [picture.pixels.shape for picture in matcher.shown] == [(80, 104, *depth)] * 2


# matchers of one's own, good and bad


def test_a_matcher_of_ones_own_is_plugged_in_by_name():
    match = own(Unit(1, "mine", 480), Unit(2, "mine", 640), mine=Orb())(*pair())
    assert [result.failure for result in match.results] == ["", ""]
    assert np.median(errors(match.matches)) < 2
    assert match.estimate.inlier_count > 30


def test_two_matchers_of_one_class_do_not_share_encodings():
    few, many = Orb(30), Orb(600)
    match = own(Unit(1, "few", 480), Unit(1, "many", 480), few=few, many=many)(*pair())
    alone = own(Unit(1, "many", 480), many=many)(*pair())
    assert same(match.results[1].matches, alone.matches)


BAD = np.array([[10.0, 10], [np.nan, 10], [10, np.inf], [-3, 10], [10, 360], [480, 5], [470, 350]])


@pytest.mark.parametrize("wrong", [0, 1])
def test_points_that_are_not_on_the_image_are_dropped(wrong):
    good = np.full_like(BAD, 20)
    answer = Matches(*((BAD, good) if wrong == 0 else (good, BAD)), np.ones(7))
    match = own(Unit(1, "own", 480), own=Scripted(answer))(*pair())
    assert (match.matches.points0, match.matches.points1)[wrong].tolist() == [[10, 10], [470, 350]]
    assert not match.estimate.ok
    assert match.estimate.inliers.tolist() == [False, False]


def test_scores_that_are_not_finite_are_dropped():
    answer = Matches(np.full((3, 2), 9), np.full((3, 2), 9), [0.5, np.nan, np.inf])
    assert own(Unit(1, "own", 480), own=Scripted(answer))(*pair()).matches.scores.tolist() == [0.5]


def test_points_on_the_padding_are_dropped():
    answer = Matches([[79, 79], [99, 74], [100, 10]], [[5, 5]] * 3, np.ones(3))
    match = own(Unit(1, "own", 100), own=Scripted(answer, multiple=32))(*pair())  # content 100 x 75 of 128 x 96
    assert len(match.matches) == 1
    assert_allclose(match.matches.points0, [[99.5 * 4.8 - 0.5, 74.5 * 4.8 - 0.5]], atol=1e-3)


@pytest.mark.parametrize("error", [RuntimeError("out of luck"), cv2.error("no"), ValueError()])
def test_a_matcher_that_raises_costs_its_unit_and_the_run_goes_on(error):
    match = own(Unit(1, "bad", 480), Unit(1, "sift", 480), Unit(2, "bad", 480), bad=Scripted(error))(*pair())
    assert [bool(result.failure) for result in match.results] == [True, False, True]
    assert match.results[0].failure == f"{type(error).__name__}: {error}"
    assert len(match.results[0].matches) == 0
    assert match.estimate.ok


@pytest.mark.parametrize("error", [MemoryError("full"), RuntimeError("CUDA error: unspecified launch failure")])
def test_memory_and_devices_are_no_failure_of_a_matcher(error):
    with pytest.raises(type(error), match=str(error)):
        own(Unit(1, "bad", 480), bad=Scripted(error))(*pair())


def test_a_matcher_that_answers_with_too_few_results_has_failed():
    class Short(Scripted):
        def match(self, encodings0, encodings1):
            return []

    match = own(Unit(1, "own", 480), own=Short())(*pair())
    assert "ValueError" in match.results[0].failure


def test_a_matcher_that_finds_nothing_has_not_failed_but_the_pair_has():
    match = own(Unit(1, "own", 480), Unit(2, "own", 480), own=Scripted())(*pair())
    assert [result.failure for result in match.results] == ["", ""]
    assert "too few" in match.estimate.failure
    assert [region.reason for region in match.regions] == ["too few points"] * 2


def test_an_interrupt_is_no_failure_of_a_matcher():
    class Interrupted(Scripted):
        def encode(self, pictures):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        own(Unit(1, "own", 480), own=Interrupted())(*pair())


def test_options_of_the_recipe_reach_the_matcher():
    match = TwoStageMatcher(replace(SIFT, matchers={"sift": {"features": 60}}))(*pair())
    assert 0 < len(match.matches) <= 61


def test_the_wait_for_the_device_counts_as_encoding_not_as_matching(monkeypatch):
    """Kernels run on while Python goes on; looking for NaN in the features is what waits for them."""
    check = units.check_finite

    def wait(*values):
        time.sleep(0.2)
        check(*values)

    monkeypatch.setattr(units, "check_finite", wait)
    (result,) = TwoStageMatcher(SIFT)(*pair()).results
    assert result.encode_seconds >= 2 * 0.2  # two images, one at a time
