"""The lines of a run's summary: doubts, weakest cameras, unfinished work, matchers that do not run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from run_tables import UNIT, Described, tables_of

from mkpc_kaggle.engine.request import Ending, RunReport
from mkpc_kaggle.engine.store.tables import NOT_RECONSTRUCTED, About, SceneRecord
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.reporting import summary as summary_module
from mkpc_kaggle.reporting.run_log import RunLog
from mkpc_kaggle.reporting.summary import (
    is_doubtful,
    left_out_line,
    pending_lines,
    summary,
    unit_means,
    weakest_cameras,
    weakest_line,
)
from mkpc_kaggle.reporting.verdict import verdict
from mkpc_kaggle.scene.choose import Reason
from mkpc_kaggle.scene.models import RegisteredImage, SfmModel, Sigmas
from mkpc_kaggle.scene.view_graph import BatchImage

# As a run leaves a pair that it had no time for
UNREACHED = Described(failure=None)
# Support below 20: they may show different things
FEW_INLIERS = Described(support=14.4)


def camera(name: str, sigmas: Sigmas | tuple[()]) -> RegisteredImage:
    pose = Camera(np.eye(3), np.eye(3), np.zeros(3))
    return RegisteredImage(BatchImage(name, name, Size(80, 60)), pose, 50, sigmas)


def scene(*cameras: RegisteredImage) -> SceneRecord:
    return SceneRecord("batch", models=(SfmModel(cameras, np.zeros((0, 3)), 0.5),))


def report(ending: Ending, *pairs: Described, scenes: tuple[SceneRecord, ...] = ()) -> RunReport:
    return RunReport(tables_of(*pairs), ending, 60.0, scenes=scenes)


def test_a_pair_with_few_inliers_is_doubtful_unless_its_cameras_agree():
    # The cameras agree with many pairs, so few inliers of one say nothing.
    settled = Described(support=14.4, choice=Reason.SCENE, source="scene")
    contradicting = Described(support=14.4, choice=Reason.CONTRADICTION)
    pairs = tables_of(FEW_INLIERS, settled, contradicting).pairs
    assert is_doubtful(pairs).tolist() == [True, False, True]


def test_an_f_of_an_earlier_run_is_counted_as_such_and_is_not_doubtful():
    """With other settings, this run knows neither its matches nor its inliers."""
    earlier = Described(source="earlier", failure=None)
    done = Described(source="pair", matches=200, inliers=100, support=99.0)
    tables = tables_of(earlier, done, UNREACHED)
    assert is_doubtful(tables.pairs).tolist()[:2] == [False, False]
    text = summary(RunReport(tables, Ending.INTERRUPTED, 60.0))
    assert "2 of 3 pairs with an F" in text
    assert "1 from their own matches, 1 of an earlier run, 1 fallback" in text
    assert "the median; the minimum is 100" in text
    assert "interrupted; 2 pairs left" in text


def test_the_means_of_a_unit_leave_out_the_pairs_on_which_it_failed():
    done = Described(matches=200, inliers=100, seconds=2.0)
    failed = Described(error="KeyError: 'x'")
    means = unit_means(report(Ending.COMPLETE, failed, done, failed))
    assert means == [(UNIT, 1, 200.0, 100.0, 2.0)]


def test_cameras_with_unknown_errors_are_the_weakest():
    # Unknown errors are larger than any known one.
    found = scene(
        camera("known.png", Sigmas(0.1, 0.02, 1.0)),
        camera("unknown.png", ()),
        camera("worse.png", Sigmas(0.1, 0.03, 1.0)),
    )
    assert [name for name, _ in weakest_cameras([found])] == [
        "unknown.png",
        "worse.png",
        "known.png",
    ]
    lines = list(weakest_line([found]))
    assert max(map(len, lines)) <= 100
    text = " ".join(line.strip() for line in lines)
    assert text.endswith(": unknown.png (unknown), worse.png (3 %), known.png (2 %)")


def test_cameras_of_a_model_that_is_too_large_for_expected_errors_are_not_the_weakest(monkeypatch):
    monkeypatch.setattr(summary_module, "MAX_SIGMA_IMAGES", 2)
    large = scene(*(camera(f"{number}.png", ()) for number in range(3)))
    small = scene(camera("known.png", Sigmas(0.1, 0.02, 1.0)))
    text = " ".join(line.strip() for line in weakest_line([large, small]))
    assert text.startswith("no expected errors of cameras in 1 model of more than 2 images (3)")
    assert text.endswith("error of the centre: known.png (2 %)")
    assert "unknown" not in text
    assert [name for name, _ in weakest_cameras([large, small])] == ["known.png"]


def test_an_interrupted_run_says_how_to_continue_and_lists_no_failures():
    # Its batch was never reconstructed.
    pending = replace(scene(), failure=NOT_RECONSTRUCTED, models=())
    stopped = report(Ending.INTERRUPTED, UNREACHED, UNREACHED, scenes=(pending,))
    assert list(pending_lines(stopped)) == [
        "interrupted; 2 pairs and 1 batch left; run the same command to continue"
    ]
    assert "not reached" not in summary(stopped)
    assert NOT_RECONSTRUCTED not in summary(stopped)


def test_a_run_whose_time_is_up_says_what_is_left():
    late = report(Ending.TIME_IS_UP, UNREACHED, FEW_INLIERS)
    assert list(pending_lines(late)) == ["1 pair left; run the same command to continue"]
    assert list(pending_lines(report(Ending.COMPLETE, FEW_INLIERS))) == []


@pytest.mark.parametrize(
    ("matchers", "left_out", "line"),
    [
        (("sift", "loma"), (), ""),
        (
            ("sift",),
            ("no weights: loma, roma",),
            "RootSIFT only; `mkpc weights fetch light --out weights` adds learned matchers",
        ),
        (
            ("sift", "loftr"),
            ("no weights: loma (`mkpc weights fetch loma-b128 --out DIR` gets weights)",),
            "left out, no weights: loma (`mkpc weights fetch loma-b128 --out DIR` gets weights)",
        ),
        (
            ("sift", "loftr"),
            ("no weights: loma, roma, dkm, superglue",),
            "4 matchers without weights; `mkpc recipes auto` lists them",
        ),
        (
            ("sift", "loftr"),
            ("weights not permitted: superglue",),
            "left out, weights not permitted: superglue",
        ),
    ],
)
def test_matchers_that_do_not_run_are_one_short_line(matchers, left_out, line):
    units = tuple(Unit(1, matcher, 640) for matcher in matchers)
    assert left_out_line(Recipe(units, "auto (stage-1)"), left_out) == line


def test_no_line_of_the_summary_is_longer_than_100_characters():
    lines = summary(report(Ending.COMPLETE, FEW_INLIERS)).splitlines()
    assert any(line.startswith("seconds a pair: wait for decoding") for line in lines)
    assert max(map(len, lines)) <= 100


def model(*centres: float | None) -> SfmModel:
    """A model of cameras with these expected errors of their centres; ``None``: unknown."""
    cameras = []
    for number, centre in enumerate(centres):
        sigmas = () if centre is None else Sigmas(0.1, centre, 1.0)
        cameras.append(camera(f"{number}.png", sigmas))
    return SfmModel(tuple(cameras), np.zeros((0, 3)), 0.5)


@pytest.mark.parametrize(
    ("centres", "is_loose"),
    [
        ((0.01, 0.02, 0.1), False),
        ((0.39, 0.5, 1.06), True),
        ((0.01, 0.02, 1.06), False),  # one uncertain camera is no loose model
        ((None, None, None), True),
        ((0.01,) * 201, False),
        ((None,) * 201, False),  # too many images for sigmas
    ],
)
def test_a_model_is_loose_if_most_cameras_are_unknown_to_within_its_size(centres, is_loose):
    assert model(*centres).is_loose is is_loose


def test_images_of_a_loose_model_alone_are_counted_apart():
    sure = model(0.01, 0.02, 0.03)
    loose = model(0.5, 0.6, 0.7, 0.8)  # one more image than the other
    record = SceneRecord("batch", images=5, registered=4, models=(loose, sure))
    assert record.loose == 1
    text = summary(report(Ending.COMPLETE, scenes=(record,)))
    line = "images with a camera: 4 of 5 (in 1 batch; 1 of them unknown to within the size of their model)"
    assert line in text
    assert "unknown to within" not in summary(report(Ending.COMPLETE, scenes=(scene(),)))


def test_the_verdict_counts_no_camera_of_a_loose_model_and_says_what_to_add():
    loose = SceneRecord("batch", images=4, registered=4, models=(model(0.39, 0.5, 0.7, 1.06),))
    log = RunLog(
        Path("work"), About(), Recipe((Unit(1, "sift", 64),)), tables_of(), (), (), (loose,)
    )
    found = verdict(log)
    assert found.text.startswith("0 of 4 images with a camera")
    (problem,) = [problem for problem in found.problems if "loosely" in problem]
    assert problem == (
        "a model of 4 cameras hangs together loosely: its cameras are unknown to within 60 % of its size; "
        "add photographs that connect its parts"
    )
    sure = replace(loose, models=(model(0.01, 0.01, 0.01, 0.01),))
    found = verdict(replace(log, scenes=(sure,)))
    assert found.text.startswith("4 of 4 images with a camera")
    assert not found.problems
