"""Scenes in whole runs: whose F a pair gets, and what a reconstruction that goes wrong costs."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from exif_files import set_exif
from faulty import (
    SCENE_F,
    befall,
    choose_scene_for_all_but_the_first,
    die_within_pycolmap,
    lack_an_image,
    scene_in_a_gigabyte,
    scenes_by,
)
from rectified import SIZE, THREE_UNITS, RectifiedMatcher, batch_pairs, matrices, run, sources
from run_tables import matrices_of
from synthetic import RECIPE as SYNTHETIC
from synthetic import SyntheticMatcher, synthetic_pairs

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.frames import results
from mkpc_kaggle.engine.request import Ending, SceneJob
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.reporting.page import page
from mkpc_kaggle.reporting.summary import summary
from mkpc_kaggle.scene.choose import Reason
from mkpc_kaggle.scene.sfm import Solution

RECIPE = replace(THREE_UNITS, scene=SceneConfig())


def own_matrices(pairs: list[Pair], directory: Path) -> list[bytes]:
    return matrices(run(pairs, THREE_UNITS, RectifiedMatcher(), directory))


def test_pairs_get_the_f_of_their_scene_and_keep_their_own(tmp_path, monkeypatch):
    scenes_by(monkeypatch, choose_scene_for_all_but_the_first, process=True)
    pairs = batch_pairs(tmp_path / "images")
    published = []
    publish = lambda state: published.append(state.written[1])  # noqa: E731
    report = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work", publish=publish)
    assert report.ending is Ending.COMPLETE
    assert sources(report) == ["pair"] + ["scene"] * 5
    chosen = matrices_of(report.pairs)
    assert all(np.array_equal(F, SCENE_F) for F in chosen[1:])
    # A scene replaces no pair's own F: another setting of scenes may need it.
    assert matrices(report) == own_matrices(pairs, tmp_path / "alone")
    assert report.pairs["choice"][0] == Reason.CONTRADICTION
    assert np.array_equal(published[-1], chosen)
    found = results(tmp_path / "work")
    assert "6 of 6 pairs with an F, 4 of 4 images with a camera" in summary(found)
    assert "F: 5 from cameras, 1 from their own matches" in summary(found)
    # The page has the counts of the terminal.
    assert "4 of 4 images with a camera" in page(found)
    assert "both cameras are known" in page(found)
    (match,) = found.matches(pairs[0].id)
    assert len(match.results[0].matches), "pictures have points"


def test_a_scene_s_matrix_of_rank_3_leaves_the_f_of_the_pair(tmp_path, monkeypatch):
    monkeypatch.setattr("faulty.SCENE_F", np.eye(3))
    scenes_by(monkeypatch, choose_scene_for_all_but_the_first)
    report = run(batch_pairs(tmp_path / "images"), RECIPE, RectifiedMatcher(), tmp_path)
    assert sources(report) == ["pair"] * 6


def test_a_focal_length_of_exif_goes_to_the_pairs_the_store_and_the_scene(
    tmp_path, monkeypatch
):
    pairs = batch_pairs(tmp_path / "images", 3)
    jobs = list[SceneJob]()

    def note(job: SceneJob) -> Solution:
        jobs.append(job)
        return choose_scene_for_all_but_the_first(job)

    scenes_by(monkeypatch, note)
    # COLMAP's rule: 28 mm of a film whose diagonal is 43.27 mm
    told = pytest.approx(28 / 43.27 * np.hypot(*SIZE))
    recipe = replace(RECIPE, focal=FocalConfig())
    reports = []
    # Image 0 is the first of two pairs. It gets its EXIF after the first run.
    cases = [
        ("without", [(0, 0)] * 3),
        ("with", [(told, 0), (told, 0), (0, 0)]),
    ]
    for name, expected in cases:
        reports.append(run(pairs, recipe, RectifiedMatcher(), tmp_path / name))
        with Store.read(tmp_path / name) as store:
            known = dict(store.db.execute("SELECT key, focal FROM image"))
        assert [(known[pair.file0], known[pair.file1]) for pair in pairs] == expected
        set_exif(pairs[0].images[0], tA405=28)
    without, with_exif = (each.pairs["own"] for each in reports)
    assert not np.array_equal(without[0], with_exif[0])
    assert np.array_equal(without[2], with_exif[2]), "the pair of the other images"
    assert [pair.images[0].focal for pair in jobs[-1].pairs] == [told, told, 0]


def test_a_reconstruction_that_is_lost_costs_its_scene_alone_is_named_and_tried_again_by_the_next_run(
    tmp_path, monkeypatch, capfd
):
    scenes_by(monkeypatch, partial(befall, lack_an_image), process=True)
    reason = "the worker failed: KeyError: 'image 7'"
    pairs = batch_pairs(tmp_path / "images")
    report = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    assert report.ending is Ending.WITH_FAILURES
    assert matrices(report) == own_matrices(pairs, tmp_path / "alone")
    assert sources(report) == ["pair"] * 6
    (fault,) = report.about.faults[1:]
    assert fault.startswith(f"batch one was not reconstructed: {reason}")
    assert report.scenes["failure"][0].startswith(reason)
    assert f"1 batch without cameras ({reason}" in summary(report)
    # pycolmap prints to the descriptors, which would tear the progress bar.
    assert capfd.readouterr() == ("", "")
    # Failures are not stored, so the same command tries the scene again, and matches nothing.
    scenes_by(monkeypatch, choose_scene_for_all_but_the_first, process=True)
    matcher = RectifiedMatcher()
    again = run(pairs, RECIPE, matcher, tmp_path / "work")
    assert sources(again) == ["pair"] + ["scene"] * 5
    assert matcher.calls == []


def test_a_run_reconstructs_the_true_cameras_and_a_gigabyte_is_enough(tmp_path, monkeypatch):
    scenes_by(monkeypatch, scene_in_a_gigabyte, process=True)
    matcher = SyntheticMatcher()
    report = run(synthetic_pairs(tmp_path / "images"), SYNTHETIC, matcher, tmp_path / "work")
    assert report.about.faults == []
    assert sources(report) == ["scene"] * 15
    distances = []
    for F, pair in zip(matrices_of(report.pairs), matcher.scene.pairs, strict=True):
        distances.append(matcher.scene.median_distance(F, pair))
    # Pixels between true points and the lines of F
    assert max(distances) < 0.5


def test_a_death_within_pycolmap_costs_the_scene_alone_and_leaves_no_files(
    tmp_path, monkeypatch
):
    # pycolmap reads its database there; a process that was killed cannot remove it.
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    scenes_by(monkeypatch, die_within_pycolmap, process=True)
    pairs = synthetic_pairs(tmp_path / "images", 4)
    report = run(pairs, SYNTHETIC, SyntheticMatcher(images=4), tmp_path / "work")
    assert report.ending is Ending.WITH_FAILURES
    assert sources(report) == ["pair"] * 6
    assert report.scenes["failure"].all()
    assert list((tmp_path / "temporary").iterdir()) == []


def test_a_resumed_run_reconstructs_only_the_batch_whose_image_was_replaced(
    tmp_path, monkeypatch
):
    scenes_by(monkeypatch, choose_scene_for_all_but_the_first)
    one = batch_pairs(tmp_path / "images")
    two = batch_pairs(tmp_path / "others", 3, "two")
    pairs = one + two
    run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    cv2.imwrite(str(pairs[0].images[0]), np.full((72, 80, 3), 200, np.uint8))
    # From now on every reconstruction fails, so a success is the stored one.
    scenes_by(monkeypatch, partial(befall, lack_an_image))
    again = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    assert sources(again) == ["pair"] * 6 + ["pair", "scene", "scene"]
    has_failed = again.scenes.set_index("batch")["failure"] != ""
    assert has_failed.to_dict() == {"one": True, "two": False}
    assert matrices(again) == own_matrices(pairs, tmp_path / "alone")
