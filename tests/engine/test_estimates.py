"""After a change of the estimation, F and cameras are computed again from the stored points."""

import os
import signal
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import pytest
from rectified import RectifiedMatcher, run
from synthetic import QUICK, RECIPE, SyntheticMatcher, synthetic_pairs

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.frames import results
from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.recipe import CameraSharing, Recipe, SceneConfig
from mkpc_kaggle.reporting.summary import summary

ALONE = replace(RECIPE, scene=None)
ESTIMATIONS = {  # in this order; each continues from the journal of the one before
    "scene": RECIPE,
    "no scene": ALONE,
    "threshold": replace(ALONE, magsac=replace(QUICK, threshold=1.0)),
    "prior": replace(ALONE, focal=FocalConfig()),
    "another scene": replace(
        RECIPE, focal=FocalConfig(scale=0.2), scene=SceneConfig(cameras=CameraSharing.IMAGE)
    ),
}


class NoMatcher(RectifiedMatcher):
    def encode(self, pictures):
        raise AssertionError("nothing is matched")


def submission(
    pairs: Sequence[Pair],
    recipe: Recipe,
    work_dir: Path,
    matcher: RectifiedMatcher | None = None,
):
    """The bytes of the file, and the report."""
    output = work_dir.with_suffix(".csv")
    report = run(
        pairs, recipe, matcher or SyntheticMatcher(images=4), work_dir, output=output
    )
    assert report.ending is Ending.COMPLETE
    return output.read_bytes(), report


def test_a_run_resumed_with_another_estimation_ends_with_the_bytes_of_a_fresh_one(
    tmp_path, monkeypatch
):
    pairs = synthetic_pairs(tmp_path / "images", 4)
    fresh = {}
    for name, recipe in ESTIMATIONS.items():
        fresh[name], _ = submission(pairs, recipe, tmp_path / name)
    # Equal bytes everywhere would prove nothing.
    assert len(set(fresh.values())) >= 4
    journal = tmp_path / "scene"
    for path in (tmp_path / "images").iterdir():
        path.unlink()  # no image is read
    monkeypatch.setattr(Pipeline, "load", lambda *_: pytest.fail("no matcher is loaded"))
    _, *others = ESTIMATIONS.items()
    for name, recipe in others:
        written, report = submission(pairs, recipe, journal, NoMatcher(name="synthetic"))
        assert written == fresh[name], name
        # Without the scene F is that of the pairs' own matches, which the journal has.
        estimated = 0 if name == "no scene" else 6
        assert (report.about.units_run, report.about.estimated) == (0, estimated)
        stored = results(journal).recipe
        assert stored == replace(recipe, name=stored.name)
    assert "0 units run, 6 F estimated" in summary(report)


def die_at_a_write(
    pairs: Sequence[Pair], recipe: Recipe, work_dir: Path, *, after: bool
) -> None:
    """Resume a run, and kill this process at the first write of an estimate or a scene: before it,
    or after it.
    """
    put = Store.put

    def put_and_die(store: Store, rows: dict[str, list[object]]) -> None:
        is_due = "result" in rows
        if after or not is_due:
            put(store, rows)
        if is_due:
            os.kill(os.getpid(), signal.SIGKILL)

    Store.put = put_and_die
    submission(pairs, recipe, work_dir, NoMatcher(name="synthetic"))


@pytest.mark.slow
def test_a_run_that_is_killed_while_it_estimates_again_ends_with_the_same_bytes(tmp_path):
    # 36 pairs are five jobs and a scene: each second kill leaves one of them done.
    pairs = synthetic_pairs(tmp_path / "images", 9)
    other = ESTIMATIONS["another scene"]
    matcher = SyntheticMatcher(images=9)
    undisturbed, _ = submission(pairs, other, tmp_path / "fresh", matcher)
    submission(pairs, RECIPE, tmp_path / "work", matcher)
    # A fresh interpreter each time: a fork would have this one's threads and locks.
    context = get_context("spawn")
    for number in range(10):
        settings = {"after": bool(number % 2)}
        arguments = (pairs, other, tmp_path / "work")
        process = context.Process(target=die_at_a_write, args=arguments, kwargs=settings)
        process.start()
        process.join()
        assert process.exitcode == -signal.SIGKILL
    written, _ = submission(pairs, other, tmp_path / "work", NoMatcher(name="synthetic"))
    assert written == undisturbed
