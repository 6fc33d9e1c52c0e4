"""The two stages on pictures with known correspondences, by real and by misbehaving matchers."""

from collections import Counter
from dataclasses import replace
from functools import cache
from itertools import combinations

import cv2
import numpy as np
import pytest
from exif_files import set_exif
from numpy.testing import assert_allclose, assert_array_equal
from pictures import same
from rectified import SWEEP, RectifiedMatcher
from sklearn.datasets import load_sample_image

from mkpc_kaggle.data.images import TURNS, Image
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.geometry.focal_prior import FocalConfig, FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import ModelKind
from mkpc_kaggle.matchers.adapters.sift import SiftMatcher, SiftOptions
from mkpc_kaggle.matchers.contract import MatcherSpec
from mkpc_kaggle.pipeline.pair import PairMatch, with_estimate
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
from mkpc_kaggle.recipe import Recipe, Unit

SIZE = Size(480, 360)
CORNER0 = (60, 130)
CORNER1 = (170, 50)
SCALE = 1.2
# Image 0 -> image 1, pixel centres at integers
SHIFT = SCALE * (0.5 - np.array(CORNER0)) - 0.5 + CORNER1
SIFT = Recipe((Unit(1, "sift", 480),))
TWO_STAGES = Recipe((Unit(1, "sift", 480), Unit(2, "sift", 440)))


pytestmark = pytest.mark.usefixtures("nowhere_else")


@cache
def pair():
    """Two gray canvases with the same photograph, 230 x 180 and ``SCALE`` times that, elsewhere on
    each.
    """
    # A part of each canvas: the rest is gray, so MKPC has something to crop.
    photograph = load_sample_image("china.jpg")[20:380, 60:520]
    canvases = []
    for (left, top), scale in ((CORNER0, 1), (CORNER1, SCALE)):
        width = round(230 * scale)
        height = round(180 * scale)
        resized = cv2.resize(photograph, (width, height), interpolation=cv2.INTER_AREA)
        canvas = np.full((SIZE.height, SIZE.width, 3), 128, np.uint8)
        canvas[top : top + height, left : left + width] = resized
        canvases.append(canvas)
    return tuple(canvases)


@cache
def two_stage_match():
    return TwoStageMatcher(TWO_STAGES)(*pair())


def errors(matches):
    """The distances (N,) of points 1 from where points 0 are in image 1, in pixels."""
    difference = matches.points1 - SCALE * matches.points0 - SHIFT
    return np.linalg.norm(difference, axis=1)


class Scripted:
    """A matcher that finds nothing, or raises a given error."""

    spec = MatcherSpec("own")

    def __init__(self, error=None):
        self.error = error

    def encode(self, pictures):
        return [np.zeros(3) for _ in pictures]

    def match(self, encodings0, encodings1):
        if self.error is not None:
            raise self.error
        return [Matches.empty() for _ in encodings0]


class CountingSift(SiftMatcher):
    """SIFT that counts how often each part of an image is encoded."""

    def __init__(self):
        super().__init__(SiftOptions(), "cpu")
        self.seen = Counter()

    def encode(self, pictures):
        self.seen.update(picture.view.crop for picture in pictures)
        return super().encode(pictures)


def own(*units, **matchers):
    return TwoStageMatcher(Recipe(units), matchers=matchers)


def test_both_stages_give_matches_in_full_image_pixels():
    match = two_stage_match()
    assert [result.unit for result in match.results] == list(TWO_STAGES.units)
    first, second = (result.matches for result in match.results)
    assert same(match.matches[match.in_stage(1)], first)
    assert same(match.matches[match.in_stage(2)], second)
    sides = [
        (second.points0, CORNER0, 1),
        (second.points1, CORNER1, SCALE),
    ]
    for region, (xy, corner, scale) in zip(match.regions, sides, strict=True):
        assert region.reason == "cropped"
        box = region.box
        assert box.contains(xy).all()
        # Keypoints lie a few pixels within the photograph, and CAE adds up to 5 % of its width.
        tolerance = 8 + 0.05 * 230 * scale
        end = corner + scale * np.array([230, 180])
        assert_allclose((box.left, box.top), corner, rtol=0, atol=tolerance)
        assert_allclose((box.right, box.bottom), end, rtol=0, atol=tolerance)
    assert len(match.inliers) == match.estimate.inlier_count > 100
    for result in match.results:
        assert len(result.matches) > 100
        distances = errors(result.matches)
        # A crop's offset or scale that is applied wrongly moves all points by pixels.
        assert np.median(distances) < 0.5
        assert np.mean(distances < 2) > 0.9


def test_a_prior_on_focal_lengths_comes_from_the_sizes_of_the_images_unless_the_cameras_are_known():
    focal = FocalConfig()
    matcher = TwoStageMatcher(replace(SIFT, focal=focal))
    K = np.array(
        [
            [400.0, 0, 240],
            [0, 400, 180],
            [0, 0, 1],
        ]
    )
    sizes = [Size(*image.shape[1::-1]) for image in pair()]
    by_size = [FocalPrior.of_image(size) for size in sizes]
    known = [FocalPrior(K, 0.0)] * 2  # a sigma of 0: certain
    cases = [
        (matcher(*pair()), by_size),
        (matcher(*pair(), intrinsics=(K, K)), known),
    ]
    for match, priors in cases:
        expected = estimate_with_prior(match.matches, tuple(priors), SIFT.magsac, focal)
        assert_array_equal(match.estimate.matrix, expected.matrix)
        assert match.estimate.magsac is not None
    with pytest.raises(ValueError, match="model E needs intrinsics"):
        matcher(*pair(), model=ModelKind.E)
    essential = matcher(*pair(), model=ModelKind.E, intrinsics=(K, K))
    assert essential.estimate.ok
    # A homography has no focal lengths, so no prior refines it.
    homography = matcher(*pair(), model=ModelKind.H)
    assert homography.estimate.magsac is None


def test_a_photograph_on_its_side_gives_the_same_matches_in_its_stored_pixels(tmp_path):
    paths = []
    views = []
    # EXIF's orientations of a camera upside down and on its side.
    for upright, orientation in zip(pair(), (3, 8), strict=True):
        path = tmp_path / f"{orientation}.png"
        turns = TURNS[orientation]
        stored = np.rot90(upright, -turns)
        cv2.imwrite(str(path), stored[..., ::-1])
        set_exif(path, orientation)
        paths.append(path)
        height, width, _ = stored.shape
        whole = Box.whole(Size(width, height))
        views.append(View.fit(whole, long_side=max(SIZE), turns=turns))
    found = TwoStageMatcher(TWO_STAGES)(*paths)
    expected = two_stage_match()
    upright = []
    for result in found.results:
        matches = result.matches
        points0 = views[0].from_image(matches.points0)
        points1 = views[1].from_image(matches.points1)
        upright.append(Matches(points0, points1, matches.scores))
    first, second = upright
    # Stage 1 sees the same pixels. Crops of stored pixels may differ by a row or column.
    wanted = expected.results[0].matches
    assert_allclose(first.points0, wanted.points0, atol=1e-3)
    assert_allclose(first.points1, wanted.points1, atol=1e-3)
    assert len(second) > 100
    assert np.mean(errors(second) < 2) > 0.9
    assert found.estimate.inlier_count > 100


def works(count=1):
    image0, image1 = map(Image.of_array, pair())
    part = pair()[1][:300, 100:]
    smaller = Image.of_array(np.ascontiguousarray(part))
    others = [image1, smaller, image0]
    return [PairMatch(images=(image0, other)) for other in others[:count]]


def pipeline(recipe, matcher=None, **what):
    matcher = matcher or SiftMatcher(SiftOptions(), "cpu")
    return Pipeline(recipe, lambda name: matcher, **what)


def test_results_are_in_the_order_of_the_recipe_for_any_order_of_running():
    # MAGSAC's result depends on the order of the matches, and a resumed run has another one.
    recipe = Recipe((Unit(1, "sift", 480), Unit(2, "sift", 440), Unit(1, "sift", 360)))
    (work,) = pipeline(recipe).match(works(), recipe.units)
    at_once = with_estimate(work, recipe)
    runner = pipeline(recipe)
    (work,) = works()
    for number in (2, 0, 1):
        (work,) = runner.match([work], [recipe.units[number]])
    piecemeal = with_estimate(work, recipe)
    assert [result.unit for result in at_once.results] == list(recipe.units)
    assert [result.unit for result in piecemeal.results] == list(recipe.units)
    assert same(at_once.matches, piecemeal.matches)
    assert at_once.estimate.matrix.tobytes() == piecemeal.estimate.matrix.tobytes()


def test_results_so_far_are_returned_when_no_unit_may_start():
    runner = pipeline(TWO_STAGES)
    (work,) = runner.match(works(), TWO_STAGES.units, lambda unit, _: unit.stage == 1)
    assert [result.unit.stage for result in work.results] == [1]
    (none,) = runner.match(works(), TWO_STAGES.units, lambda *_: False)
    assert none.results == ()
    assert with_estimate(none, TWO_STAGES).estimate.failure


def test_crops_come_from_the_units_before_them_and_a_pair_without_these_has_none():
    first, crop, later = Unit(1, "sift", 480), Unit(2, "sift", 440), Unit(1, "sift", 360)
    recipe = Recipe((first, crop, later))
    (work,) = pipeline(recipe).match(works(), recipe.units)
    (alone,) = pipeline(recipe).match(works(), [first, crop])
    assert [result.unit for result in work.results] == [first, crop, later]
    assert work.regions == alone.regions
    # There was no time for the unit before the crop.
    (cut,) = pipeline(recipe).match(works(), recipe.units, lambda unit, _: unit is not first)
    assert [result.unit for result in cut.results] == [later]


def test_a_minibatch_gives_what_pairs_give_alone():
    alone = pipeline(TWO_STAGES, minibatch=1).match(works(3), TWO_STAGES.units)
    together = pipeline(TWO_STAGES, minibatch=4).match(works(3), TWO_STAGES.units)
    for single, other in zip(alone, together, strict=True):
        assert single.regions == other.regions
        for one, two in zip(single.results, other.results, strict=True):
            assert same(one.matches, two.matches)


def test_whole_images_are_encoded_once_and_crops_for_each_pair():
    sift = CountingSift()
    image0, image1 = works()[0].images
    first = PairMatch(images=(image0, image1))
    runner = pipeline(TWO_STAGES, sift)
    turned = PairMatch(images=(image1, image0))
    done = runner.match([first, turned, first], TWO_STAGES.units)
    runner.match(done, TWO_STAGES.units)  # a unit that a pair has had is not run again
    assert sift.seen.pop(Box.whole(SIZE)) == 2
    # Two crops of each of three pairs.
    assert len(sift.seen) >= 2
    assert sift.seen.total() == 6


def test_two_matchers_of_one_class_do_not_share_encodings_and_the_surest_matches_are_kept():
    few = SiftMatcher(SiftOptions(features=30), "cpu")
    many = SiftMatcher(SiftOptions(features=600), "cpu")
    both = own(Unit(1, "few", 480), Unit(1, "many", 480), few=few, many=many)
    match = both(*pair())
    as_written = replace(SIFT, matchers={"sift": {"features": 600}})
    alone = TwoStageMatcher(as_written)(*pair())
    assert same(match.results[1].matches, alone.matches)
    of_fifty = own(Unit(1, "many", 480, 50), many=many)
    assert same(of_fifty(*pair()).matches, alone.matches.best(50))
    # OpenCV may keep one keypoint more, with a second orientation.
    assert 0 < len(match.results[0].matches) <= 31


def test_no_matches_are_a_result():
    with pytest.warns(RuntimeWarning, match="no F was found: too few"):
        match = own(Unit(1, "none", 480), Unit(2, "none", 480), none=Scripted())(*pair())
    assert match.failures == {}
    assert "too few" in match.estimate.failure
    assert [region.reason for region in match.regions] == ["too few points"] * 2


@pytest.mark.parametrize(
    "error", [RuntimeError("out of luck"), cv2.error("no"), ValueError()]
)
def test_a_matcher_that_raises_fails_its_units_and_the_others_run(error):
    units = [Unit(1, "bad", 480), Unit(1, "sift", 480), Unit(2, "bad", 480)]
    matchers = {"bad": Scripted(error), "sift": SiftMatcher(SiftOptions(), "cpu")}
    recipe = Recipe(units)
    (work,) = Pipeline(recipe, matchers.__getitem__).match(works(), units)
    match = with_estimate(work, recipe)
    assert [bool(result.failure) for result in match.results] == [True, False, True]
    assert match.results[0].failure == f"{type(error).__name__}: {error}"
    assert list(match.failures) == ["1:bad@480", "2:bad@480"]
    assert len(match.results[0].matches) == 0
    assert match.estimate.ok


def test_if_a_matcher_raises_for_one_pair_the_others_of_its_minibatch_are_matched():
    def moody(brightness):
        if brightness == 12:
            raise RuntimeError("no mood")
        return 150

    matcher = RectifiedMatcher(matches=moody)
    pairs = []
    for number in range(8):
        # The matcher knows an image by its brightness.
        pixels = np.full((72, 80, 3), 10 + number, np.uint8)
        image = Image(str(number), pixels)
        pairs.append(PairMatch(images=(image, image)))
    runner = pipeline(Recipe((SWEEP,)), matcher, minibatch=8)
    done = runner.match(pairs, [SWEEP])
    failures = [work.results[0].failure for work in done]
    assert failures == ["", "", "RuntimeError: no mood", *[""] * 5]
    for work in done:
        found = len(work.results[0].matches)
        assert (found > 0) == (not work.results[0].failure)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("full"),
        RuntimeError("CUDA error: unspecified launch failure"),
        KeyboardInterrupt("x"),
    ],
)
def test_errors_of_memory_or_of_a_device_and_interrupts_are_not_failures_of_a_matcher(error):
    # A smaller minibatch, another device or the user decide about these, so they are raised.
    with pytest.raises(type(error), match=str(error)):
        own(Unit(1, "bad", 480), bad=Scripted(error))(*pair())


def test_pairs_with_a_common_image_encode_it_once_and_match_as_single_pairs(tmp_path):
    paths = [tmp_path / f"{name}.png" for name in "abc"]
    photograph = load_sample_image("china.jpg")
    for number, path in enumerate(paths):
        left = 30 * number
        cv2.imwrite(str(path), photograph[20:300, left : left + 400])
    pairs = list(combinations(paths, 2))
    alone = [TwoStageMatcher(SIFT)(*pair) for pair in pairs]

    # Three images in three pairs: six encodings without a cache.
    counting = CountingSift()
    matcher = TwoStageMatcher(SIFT, matchers={"sift": counting})
    found = list(matcher.match_pairs(pairs))
    assert counting.seen.total() == 3
    for match, expected in zip(found, alone, strict=True):
        assert_array_equal(match.matches.points0, expected.matches.points0)
        assert_array_equal(match.estimate.matrix, expected.estimate.matrix)


class Loader:
    """Loads a matcher without matches, or raises the error of that name; counts the calls."""

    def __init__(self, **errors):
        self.errors = errors
        self.calls = Counter()

    def __call__(self, name):
        self.calls[name] += 1
        if name in self.errors:
            raise self.errors[name]
        return Scripted()


TWO_MATCHERS = Recipe((Unit(1, "good", 320), Unit(1, "bad", 320), Unit(2, "bad", 320)))


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (UserError("the weights do not fit"), "bad cannot be loaded: the weights do not fit"),
        (ValueError("no such layer"), "bad cannot be loaded: ValueError: no such layer"),
    ],
)
def test_a_matcher_that_cannot_be_loaded_fails_its_units_alone_and_is_tried_once(error, told):
    # Loading may read gigabytes, so it is not repeated for each minibatch.
    load = Loader(bad=error)
    pipeline = Pipeline(TWO_MATCHERS, load, minibatch=2)
    pipeline.load()
    images = tuple(map(Image.of_array, pair()))
    pairs = [PairMatch(images=images) for _ in range(3)]
    for match in pipeline.match(pairs, TWO_MATCHERS.units):
        assert [result.failure for result in match.results] == ["", told, told]
    assert load.calls == {"good": 1, "bad": 1}


def test_a_pipeline_without_a_matcher_that_can_be_loaded_raises_the_first_error():
    load = Loader(good=UserError("first"), bad=UserError("second"))
    with pytest.raises(UserError, match="first"):
        Pipeline(TWO_MATCHERS, load).load()
