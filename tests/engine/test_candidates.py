"""Candidates of a scene in whole runs: which one is used, and what the others cost."""

import json
import shutil
import time
from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from faulty import choose_scene_for_all_but_the_first, scenes_by
from pandas.testing import assert_frame_equal
from rectified import THREE_UNITS, RectifiedMatcher, batch_pairs, run
from simulator import Scenario, memory_store, simulate
from synthetic import QUICK, SyntheticMatcher, synthetic_pairs

from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.frames import Results, results
from mkpc_kaggle.engine.request import Ending, SceneJob
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.engine.worker import compute_scene
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit
from mkpc_kaggle.scene.candidates import ALL_UNITS, SUPPORTED
from mkpc_kaggle.scene.sfm import Solution
from mkpc_kaggle.setup.assembly import assemble
from mkpc_kaggle.signals import Interrupt

FIRST, _, LAST = (unit.name for unit in THREE_UNITS.units)


# All units, and the units of stage 1 alone
RECIPE = Recipe((THREE_UNITS.units[0], THREE_UNITS.units[2]), scene=SceneConfig(candidates=4))


DISAGREEMENTS = {ALL_UNITS: 5.0, SUPPORTED: 4.0, FIRST: 1.0, LAST: 3.0}


def solve(made: list[SceneJob], disagreements: dict[str, float], job: SceneJob) -> Solution:
    """Note the job. Answer with the disagreement of its candidate, and F that differs by candidate."""
    made.append(job)
    found = choose_scene_for_all_but_the_first(job)
    number = 1.0 + list(DISAGREEMENTS).index(job.candidate)
    choices = tuple(
        each if each.F is None else replace(each, F=np.diag([number, 1, 0]))
        for each in found.choices
    )
    return replace(found, choices=choices, disagreement=disagreements[job.candidate])


def numbers(report: Results) -> set[float]:
    """The numbers of the candidates whose F was written."""
    return set(report.pairs.query("source == 'scene'")["f11"])


def candidates(jobs: list[SceneJob]) -> list[str]:
    """The candidates that were made: the first, then the others, which begin at the same time."""
    first, *others = [job.candidate for job in jobs]
    return [first, *sorted(others, key=list(DISAGREEMENTS).index)]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[SceneJob]:
    jobs: list[SceneJob] = []
    scenes_by(monkeypatch, partial(solve, jobs, DISAGREEMENTS))
    return jobs


def test_a_candidate_is_a_result_under_its_key_and_is_not_made_twice(tmp_path, made):
    pairs = batch_pairs(tmp_path / "images")
    first = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    del made[:]
    again = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    assert made == []
    assert_frame_equal(again.scenes, first.scenes)
    # Fewer candidates are no reason to make the first again, more make only the missing ones.
    one = replace(RECIPE, scene=SceneConfig())
    assert numbers(run(pairs, one, RectifiedMatcher(), tmp_path / "work")) == {1.0}
    two = replace(RECIPE, scene=SceneConfig(candidates=3))
    assert numbers(run(pairs, two, RectifiedMatcher(), tmp_path / "fresh")) == {3.0}
    assert candidates(made) == [ALL_UNITS, SUPPORTED, FIRST]


def test_a_candidate_that_is_lost_costs_itself_alone_and_the_next_run_tries_it_again(
    tmp_path, made, monkeypatch
):
    def fail(job: SceneJob) -> Solution:
        if job.candidate == FIRST:
            raise RuntimeError("no cameras")
        return solve(made, DISAGREEMENTS, job)

    scenes_by(monkeypatch, fail)
    pairs = batch_pairs(tmp_path / "images")
    report = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    assert report.ending is Ending.COMPLETE
    assert numbers(report) == {4.0}
    fault = f"batch one by the tracks of {FIRST} was not reconstructed"
    assert any(each.startswith(fault) for each in report.about.faults)
    assert report.scenes["failure"].tolist() == [""]
    del made[:]
    scenes_by(monkeypatch, partial(solve, made, DISAGREEMENTS))
    again = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    assert [job.candidate for job in made] == [FIRST]
    assert numbers(again) == {3.0}


def test_without_time_for_others_the_first_candidate_is_all(tmp_path, made):
    # The forecast of any scene has the start of its process, three seconds.
    budget = Budget(time.monotonic(), 4.0)
    pairs = batch_pairs(tmp_path / "images")
    report = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work", budget=budget)
    assert [job.candidate for job in made] == [ALL_UNITS]
    assert report.ending is Ending.TIME_IS_UP
    # The same command continues.
    assert numbers(run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")) == {3.0}


@pytest.mark.parametrize("until", [20.0, 60.0, 73.0])
def test_interrupted_and_resumed_runs_choose_as_an_undisturbed_one(until):
    scenario = Scenario(12, (1.0, 1.0, 1.0), 1, 600.0, batches=3, candidates=4, misses=0)
    whole = simulate(scenario)
    assert whole.report.ending is Ending.COMPLETE
    jobs = Counter(scene.batch for scene in whole.scenes)
    store = memory_store()
    cut = simulate(scenario, store, until=until)
    resumed = simulate(scenario, store)
    chosen = whole.report.scenes["candidate"].tolist()
    assert resumed.report.scenes["candidate"].tolist() == chosen
    assert len(set(chosen)) > 1, "a choice was made"
    # What an interrupted process was making is made again, and nothing else.
    again = Counter(scene.batch for scene in [*cut.scenes, *resumed.scenes])
    assert sum(again.values()) <= sum(jobs.values()) + 1


def test_each_candidate_has_its_files_of_colmap_and_one_without_them_is_made_again(
    tmp_path, monkeypatch
):
    """Real reconstructions; the second agrees best."""
    width = 640
    units = (Unit(1, "synthetic", width), Unit(1, "synthetic", width // 2))
    recipe = Recipe(units, magsac=QUICK, scene=SceneConfig(candidates=4))
    jobs: list[SceneJob] = []

    def judge(job: SceneJob) -> Solution:
        jobs.append(job)
        return replace(compute_scene(job), disagreement=float(job.candidate != units[1].name))

    scenes_by(monkeypatch, judge)
    pairs = synthetic_pairs(tmp_path / "images", 4)
    scenes = tmp_path / "work" / "scenes"

    def ask() -> str:
        matcher = SyntheticMatcher(images=4)
        assembly = assemble(recipe, matchers={matcher.name: matcher}, device="cpu")
        session = Session(
            tmp_path / "work", Budget(time.monotonic()), Interrupt(), progress=False
        )
        report = run_pairs(pairs, assembly, session, scenes_dir=scenes)
        assert report.scenes["candidate"].tolist() == [units[1].name]
        with Store.read(tmp_path / "work") as store:
            ((_, key, _),) = json.loads(
                store.db.execute("SELECT about FROM run").fetchone()[0]
            )["scenes"]
        return key

    key = ask()
    assert sorted(path.name for path in scenes.iterdir()) == sorted(job.key for job in jobs)
    folder = scenes / key
    assert sorted(path.name for path in folder.iterdir()) == ["database.db", "models"]
    chosen = (folder / "models" / "0" / "images.bin").read_bytes()
    # Nothing is made again while the files are there.
    del jobs[:]
    assert ask() == key
    assert jobs == []
    shutil.rmtree(folder)
    assert ask() == key
    assert [job.candidate for job in jobs] == [units[1].name]
    assert (folder / "models" / "0" / "images.bin").read_bytes() == chosen


def test_the_candidate_that_agrees_best_is_used_and_no_other(tmp_path, made):
    pairs = batch_pairs(tmp_path / "images")
    report = run(pairs, RECIPE, RectifiedMatcher(), tmp_path / "work")
    assert report.ending is Ending.COMPLETE
    assert candidates(made) == [ALL_UNITS, SUPPORTED, FIRST, LAST]
    assert numbers(report) == {3.0}
    assert report.scenes["candidate"].tolist() == [FIRST]
    assert results(tmp_path / "work").scenes["candidate"].tolist() == [FIRST]
