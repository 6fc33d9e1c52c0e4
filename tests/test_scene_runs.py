"""Scenes in whole runs: whose F a pair gets, and what a reconstruction that goes wrong costs."""

import time
from dataclasses import replace
from pathlib import Path

import cv2
import faulty
import numpy as np
import pytest
from mkpc_kaggle.engine.pools import scene_process
from mkpc_kaggle.engine.pools.pool import Pool
from rectified import SWEEP, THREE_UNITS, RectifiedMatcher, run
from synthetic import RECIPE as SYNTHETIC
from synthetic import SyntheticMatcher, synthetic_pairs

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.costs import Timeouts
from mkpc_kaggle.engine.engine import Ending
from mkpc_kaggle.engine.scenes import Reconstruction, SceneJob
from mkpc_kaggle.recipe import Recipe
from mkpc_kaggle.reporting.report import report_page
from mkpc_kaggle.reporting.run_log import read_log
from mkpc_kaggle.reporting.summary import overview
from mkpc_kaggle.scene.choose import Reason
from mkpc_kaggle.scene.config import SceneConfig
from mkpc_kaggle.scene.view_graph import BatchPair

RECIPE = replace(THREE_UNITS, scene=SceneConfig())
SCENE_F = faulty.SCENE_F


def batch_pairs(directory: Path, images: int = 4, batch: str = "one") -> list[Pair]:
    """All pairs of flat images, each with a brightness of its own: 10, 20, ..."""
    directory.mkdir(parents=True, exist_ok=True)
    paths = [directory / f"{number}.png" for number in range(images)]
    for number, path in enumerate(paths):
        cv2.imwrite(str(path), np.full((72, 80, 3), 10 + 10 * number, np.uint8))
    chosen = [(i, j) for i in range(images) for j in range(i + 1, images)]
    return [Pair(f"{batch};{i}-{j}", batch, str(paths[i]), str(paths[j])) for i, j in chosen]


def fault(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(scene_process, "serve_scene", getattr(faulty, name))


def own_matrices(pairs: list[Pair], directory: Path) -> list[bytes]:
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), directory)
    return [record.pair_fundamental.tobytes() for record in report.records]


def test_pairs_get_the_f_of_their_scene_and_keep_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault(monkeypatch, "choose_scene_for_all_but_the_first")
    pairs, published = batch_pairs(tmp_path / "images"), []
    report = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work", publish=lambda r: published.append(list(r)))
    assert report.ending is Ending.COMPLETE
    assert [record.source for record in report.records] == ["pair"] + ["scene"] * 5
    assert all(np.array_equal(record.chosen_fundamental, SCENE_F) for record in report.records[1:])
    assert [record.pair_fundamental.tobytes() for record in report.records] == own_matrices(
        pairs, tmp_path / "alone"
    )
    assert published[-1][0].scene.reason is Reason.CONTRADICTION
    log = read_log(tmp_path / "work")
    assert "scenes: 1 of 1 batches reconstructed with 4 of 4 images; F of 5 of 6 pairs is from them" in overview(
        log
    )
    page = report_page(log)
    assert "both cameras are known" in page
    assert all(len(weak.results[0].matches) for weak in log.weakest), "what is drawn keeps its points"


def test_a_run_that_goes_on_does_not_reconstruct_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fault(monkeypatch, "choose_scene_for_all_but_the_first")
    pairs = batch_pairs(tmp_path / "images")
    first = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    fault(monkeypatch, "die_as_scene")
    again = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    assert again.faults == ()
    assert [r.chosen_fundamental.tobytes() for r in again.records] == [
        r.chosen_fundamental.tobytes() for r in first.records
    ]
    assert again.scenes == first.scenes


@pytest.mark.parametrize(
    ("name", "reason"),
    [("die_as_scene", "signal SIGKILL"), ("exhaust_memory_as_scene", "exit status 1"), ("raise_as_scene", "exit")],
)
def test_a_reconstruction_that_dies_costs_its_scene_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, reason: str
) -> None:
    fault(monkeypatch, name)
    pairs = batch_pairs(tmp_path / "images") + batch_pairs(tmp_path / "others", 3, "two")
    report = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    assert report.ending is Ending.COMPLETE
    assert [record.pair_fundamental.tobytes() for record in report.records] == own_matrices(
        pairs, tmp_path / "alone"
    )
    assert all(record.source == "pair" for record in report.records)
    assert [fault.partition(": its process ended: ")[0] for fault in report.faults] == [
        f"batch {batch} was not reconstructed" for batch in ("one", "two")
    ]
    assert all(reason in scene.failure for scene in report.scenes)
    assert len(report.scenes) == 2


def test_a_reconstruction_that_hangs_ends_with_the_limit_and_every_row_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault(monkeypatch, "hang_as_scene")
    pairs = batch_pairs(tmp_path / "images")
    started = time.monotonic()
    report = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work", limit=8.0)
    assert time.monotonic() - started < 8.0
    assert [len(record.units) for record in report.records] == [3] * 6
    assert all(record.source == "pair" for record in report.records)


def test_without_pycolmap_a_line_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fault(monkeypatch, "scene_without_pycolmap")
    report = run(batch_pairs(tmp_path / "images"), RECIPE, RectifiedMatcher(), tmp_path / "work")
    assert all(record.source == "pair" for record in report.records)
    assert "pycolmap cannot be imported" in overview(read_log(tmp_path / "work"))


def test_a_reconstruction_that_hangs_costs_its_scene_and_the_next_batch_has_its_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault(monkeypatch, "hang_as_scene_of_batch_one")
    pairs = batch_pairs(tmp_path / "images") + batch_pairs(tmp_path / "others", 3, "two")
    quick = Timeouts(floor=4.0, factor=2.0)
    report = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work", timeouts=quick)
    assert [record.source for record in report.records] == ["pair"] * 7 + ["scene"] * 2
    assert [fault[:50] for fault in report.faults] == ["batch one was not reconstructed: it hung: no answe"]


def test_a_run_reconstructs_the_true_cameras(tmp_path: Path) -> None:
    matcher = SyntheticMatcher()
    report = run(synthetic_pairs(tmp_path / "images"), SYNTHETIC, matcher, tmp_path / "work")
    assert [record.source for record in report.records] == ["scene"] * 15
    pairs = zip(report.records, matcher.scene.pairs, strict=True)
    assert max(matcher.scene.median_distance(record.chosen_fundamental, pair) for record, pair in pairs) < 0.5


def test_memory_that_ends_within_pycolmap_costs_the_scene_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault(monkeypatch, "exhaust_memory_within_pycolmap")
    report = run(synthetic_pairs(tmp_path / "images"), SYNTHETIC, SyntheticMatcher(), tmp_path / "work")
    assert report.ending is Ending.COMPLETE
    assert [record.source for record in report.records] == ["pair"] * 15
    assert report.scenes[0].failure


def test_a_gigabyte_is_enough_for_a_small_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fault(monkeypatch, "scene_in_a_gigabyte")
    report = run(synthetic_pairs(tmp_path / "images"), SYNTHETIC, SyntheticMatcher(), tmp_path / "work")
    assert report.ending is Ending.COMPLETE
    assert report.faults == ()
    assert [record.source for record in report.records] == ["scene"] * 15


def test_the_scene_of_a_run_is_made_of_tracks_and_judged_by_all_matches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[BatchPair] = []
    made = Pool.reconstruct

    def note(pool: Pool, job: SceneJob) -> Reconstruction:
        given.extend(job.pairs)
        return made(pool, job)

    monkeypatch.setattr(Pool, "reconstruct", note)
    first, *others = THREE_UNITS.units
    recipe = replace(RECIPE, units=(replace(first, tracks=False), *others))
    run(batch_pairs(tmp_path / "images"), recipe, RectifiedMatcher(), tmp_path / "work")
    assert len(given) == 6
    assert all(0 < sum(map(len, pair.tracks.values())) < len(pair.matches) for pair in given)


def test_a_recipe_without_scenes_starts_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fault(monkeypatch, "die_as_scene")
    report = run(batch_pairs(tmp_path / "images"), Recipe((SWEEP,)), RectifiedMatcher(), tmp_path / "work")
    assert report.scenes == ()
    assert report.faults == ()


def test_an_image_replaced_after_the_run_drops_the_scene_and_its_batch_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault(monkeypatch, "choose_scene_for_all_but_the_first")
    pairs = batch_pairs(tmp_path / "images") + batch_pairs(tmp_path / "others", 3, "two")
    run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    cv2.imwrite(str(pairs[0].image0), np.full((72, 80, 3), 200, np.uint8))
    fault(monkeypatch, "die_as_scene")
    with pytest.warns(UserWarning, match="6 pairs are matched anew"):
        again = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    assert [record.source for record in again.records] == ["pair"] * 6 + ["pair", "scene", "scene"]
    assert {scene.batch: bool(scene.failure) for scene in again.scenes} == {"one": True, "two": False}
    assert [record.pair_fundamental.tobytes() for record in again.records] == own_matrices(
        pairs, tmp_path / "alone"
    )
