"""The two stages on pictures whose correspondence is known, with real matchers and with those that misbehave."""

import time
from collections import Counter
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from shared import WEIGHTS, needs_weights
from sklearn.datasets import load_sample_image
from weight_files import digest_of

from mkpc_kaggle.data.images import Image
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, Model, Origin
from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, Placement
from mkpc_kaggle.matchers.sift import SiftMatcher, SiftOptions
from mkpc_kaggle.pipeline import units
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.pipeline.obstacles import Licence
from mkpc_kaggle.pipeline.pair import PairMatch, with_estimate
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
from mkpc_kaggle.recipe import Mode, Recipe, Unit, load_recipe
from mkpc_kaggle.weights import WeightFile, manifest
from mkpc_kaggle.weights import store as weight_store

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


@pytest.fixture(autouse=True)
def nowhere_else(monkeypatch, tmp_path):
    """Weights are searched only where a test says."""
    monkeypatch.delenv("MKPC_WEIGHTS", raising=False)
    monkeypatch.setattr(weight_store, "KAGGLE_INPUT", tmp_path / "no kaggle")


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


def test_matchers_of_one_size_get_pictures_of_one_size():
    matcher = Scripted(same_size=True, multiple=32)
    tall, wide = np.full((300, 100, 3), 9, np.uint8), np.full((100, 280, 3), 9, np.uint8)
    own(Unit(1, "own", 256), own=matcher)(tall, wide)
    assert [picture.pixels.shape for picture in matcher.shown] == [(256, 256, 3)] * 2
    assert [picture.content for picture in matcher.shown] == [(85, 256), (256, 91)]
    assert not matcher.shown[0].pixels[:, 85:].any()
    assert matcher.shown[0].pixels[:, :85].all()


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


# putting a run together


def test_recipe_auto_leaves_out_the_units_whose_weights_are_missing():
    assembly = assemble("auto")
    recipe = load_recipe("auto")
    assert assembly.recipe.matcher_names == ("sift",)
    assert assembly.left_out == tuple(unit for unit in recipe.units if unit.matcher != "sift")
    assert assembly.left_out
    assert assembly.fingerprint()["weights"] == {}


@needs_weights
def test_recipe_auto_takes_all_whose_weights_are_there():
    assembly = assemble("auto", weights=[WEIGHTS])
    recipe = load_recipe("auto")
    there = {"xfeat_lighterglue", "sift", "aliked"}
    assert set(assembly.recipe.matcher_names) == there
    assert assembly.recipe == recipe.only(lambda unit: unit.matcher in there)
    assert assembly.left_out == tuple(unit for unit in recipe.units if unit not in assembly.recipe.units)
    assert all(digest.startswith("sha256:") for digest in assembly.fingerprint()["weights"].values())
    assert set(assembly.fingerprint()["weights"]) == {"xfeat", "xfeat-lighterglue", "aliked-n16"}


@pytest.mark.parametrize("recipe", ["light", replace(load_recipe("light"), name="x")])
def test_a_named_recipe_without_its_weights_is_refused_with_the_file_names(recipe):
    with pytest.raises(
        UserError, match=r"needs weights.*xfeat\.pt or xfeat_sparse.*aliked-n16\.pth or .*--weights"
    ):
        assemble(recipe)


@needs_weights
def test_a_fallback_stands_in_for_a_matcher_whose_weights_are_missing():
    assembly, recipe = assemble("light", weights=[WEIGHTS]), load_recipe("light")
    assert assembly.recipe.matcher_names == ("xfeat_lighterglue", "sift", "aliked")
    assert [unit.name for unit in assembly.left_out] == ["1:aliked_lightglue@1024", "2:aliked_lightglue@800"]
    assert [unit.stage for unit in assembly.recipe.units] == [unit.stage for unit in recipe.units]
    assert assembly.recipe.fingerprint() == assembly.recipe.decided(()).fingerprint()


def test_an_unknown_fallback_is_refused_even_where_it_is_not_needed():
    with pytest.raises(UserError, match="unknown matcher 'alked'"):
        assemble(Recipe((Unit(1, "sift", 640, fallback="alked"),)))


def standins(directory, *names):
    """A search directory with files of these names, and a manifest that knows them by slot and licence."""
    for name, _, _ in names:
        (directory / name).write_bytes(name.encode())
    return [WeightFile(name, -1, digest_of(name.encode()), licence, slot, "here") for name, slot, licence in names]


SUPERGLUE = (
    ("sp.pth", "superpoint", "Magic-Leap-noncommercial"),
    ("sg.pth", "superglue-outdoor", "Magic-Leap-noncommercial"),
)
PERMITTED = (("loftr.ckpt", "loftr-outdoor", "Apache-2.0"), ("dkm.pth", "dkm-outdoor", "MIT"))


@pytest.fixture
def known_files(monkeypatch, tmp_path):
    """SuperGlue's, LoFTR's and DKM's weights are there, DKM's also for indoors, of unclear terms."""
    files = standins(tmp_path, *SUPERGLUE, *PERMITTED, ("dkm_in.pth", "dkm-indoor", "unclear"))
    others = [file for file in manifest() if file.slot not in {known.slot for known in files}]
    monkeypatch.setattr(weight_store, "manifest", lambda: (*files, *others))
    return tmp_path


def test_a_permissive_run_leaves_out_of_recipe_auto_what_is_licensed_otherwise(known_files):
    every = assemble("auto", weights=[known_files])
    assert every.recipe.matcher_names == ("superglue", "loftr", "sift", "dkm")
    some = assemble("auto", weights=[known_files], licence=Licence.PERMISSIVE)
    assert some.recipe.matcher_names == ("loftr", "sift", "dkm")
    assert {unit.matcher for unit in some.left_out} >= {"superglue", "aspanformer"}
    assert set(some.fingerprint()["weights"]) == {"loftr-outdoor", "dkm-outdoor"}


@pytest.mark.filterwarnings("ignore:.*is not verified")
def test_a_fallback_stands_in_for_a_matcher_whose_weights_are_not_permitted_or_not_there(known_files):
    recipe = Recipe((Unit(1, "superglue", 640, fallback="loftr"), Unit(2, "dkm", area="90x120")))
    every = assemble(recipe, weights=[known_files])
    assert (every.recipe.matcher_names, every.left_out) == (("superglue", "dkm"), ())
    some = assemble(recipe, weights=[known_files], licence=Licence.PERMISSIVE)
    assert (some.recipe.matcher_names, some.left_out) == (("loftr", "dkm"), recipe.units[:1])
    (known_files / "sp.pth").unlink()
    assert assemble(recipe, weights=[known_files]).recipe == some.recipe


@pytest.mark.parametrize("recipe", ["yfcc", "imc2022", load_recipe("scannet")])
def test_a_permissive_run_refuses_a_recipe_by_matcher_and_licence_and_says_what_to_do(recipe):
    says = r"permissive refuses recipe '\w+' .*superglue \(Magic-Leap-noncommercial\).*recipe auto"
    with pytest.raises(UserError, match=says):
        TwoStageMatcher(recipe, licence="permissive")


def test_the_licence_of_the_file_counts_too(known_files):
    recipe = Recipe((Unit(1, "dkm", area="90x120"),), matchers={"dkm": {"training": "outdoor"}})
    assert assemble(recipe, weights=[known_files], licence=Licence.PERMISSIVE).left_out == ()
    indoors = replace(recipe, matchers={"dkm": {"training": "indoor"}})
    assert set(assemble(indoors, weights=[known_files]).fingerprint()["weights"]) == {"dkm-indoor"}
    with pytest.raises(UserError, match=r"dkm \(unclear\)"):
        assemble(indoors, weights=[known_files], licence=Licence.PERMISSIVE)


def test_the_licence_of_a_matcher_of_ones_own_counts():
    recipe = Recipe((Unit(1, "own", 480),))
    for tags in ((), ("MIT",)):
        matchers = {"own": Scripted(licences=tags)}
        assert assemble(recipe, matchers=matchers, licence=Licence.PERMISSIVE).recipe == recipe
    with pytest.raises(UserError, match=r"own \(GPL\)"):
        assemble(recipe, matchers={"own": Scripted(licences=("GPL", "MIT"))}, licence=Licence.PERMISSIVE)


def test_the_permissive_recipe_is_refused_for_nothing_but_missing_weights():
    for recipe in ("permissive", "best"):
        with pytest.raises(UserError, match="needs weights"):
            assemble(recipe, licence=Licence.PERMISSIVE)


@pytest.mark.filterwarnings("ignore:.*is not verified")
@pytest.mark.parametrize("name", ["xfeat_sparse_bnfolded.safetensors", "DKMv3_outdoor.pth"])
def test_recipe_auto_passes_damaged_weights_over(tmp_path, name):
    """The second has no digest in the manifest: it is found out when it is read."""
    (tmp_path / name).write_bytes(b"cut off")
    with pytest.warns(UserWarning, match=rf"(passed over|does without dkm): .*{name}"):
        assembly = assemble("auto", weights=[tmp_path])
    assert not {"dkm", "xfeat_lighterglue"} & set(assembly.recipe.matcher_names)


@pytest.mark.parametrize("device", ["gpu", "", "CPU", "mps"])
def test_an_unknown_device_is_refused_with_the_known_ones(device):
    with pytest.raises(UserError, match=r"unknown device.*auto, cpu, cuda, cuda:N"):
        assemble("classical", device=device)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_gpu_that_is_not_there_is_refused_and_auto_takes_the_cpu():
    with pytest.raises(UserError, match=r"cuda:0.*no GPU.*--device cpu"):
        assemble("classical", device="cuda:0")
    assert assemble("classical").placement == Placement()


def test_an_unknown_matcher_or_option_is_refused_before_any_work():
    with pytest.raises(UserError, match="unknown matcher 'own'"):
        assemble(Recipe((Unit(1, "own", 480),)))
    with pytest.raises(UserError, match=r"unknown key 'x'"):
        assemble(Recipe((Unit(1, "sift", 480),), matchers={"sift": {"x": 1}}))
    with pytest.raises(UserError, match="unknown recipe 'x'"):
        TwoStageMatcher("x")


def test_a_mode_changes_the_units_that_run():
    assembly = assemble("classical", mode=Mode.STAGE_1)
    assert {unit.stage for unit in assembly.recipe.units} == {1}
    assert assembly.fingerprint() != assemble("classical").fingerprint()


def test_options_of_the_recipe_reach_the_matcher():
    match = TwoStageMatcher(replace(SIFT, matchers={"sift": {"features": 60}}))(*pair())
    assert 0 < len(match.matches) <= 61


def test_what_another_precision_computes_is_another_run() -> None:
    exact, half = (assemble("classical", precision=precision) for precision in ("float32", "bfloat16"))
    assert exact.fingerprint() != half.fingerprint()


def test_the_wait_for_the_device_counts_as_encoding_not_as_matching(monkeypatch):
    """Kernels run on while Python goes on; looking for NaN in the features is what waits for them."""
    check = units.check_finite

    def wait(*values):
        time.sleep(0.2)
        check(*values)

    monkeypatch.setattr(units, "check_finite", wait)
    (result,) = TwoStageMatcher(SIFT)(*pair()).results
    assert result.encode_seconds >= 2 * 0.2  # two images, one at a time
