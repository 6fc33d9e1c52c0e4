"""Workers that lie: each answer is checked once, where it arrives, and a wrong one is a loss."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faulty import choose_scene_for_all_but_the_first, runner, scenes_by
from rectified import (
    THREE_UNITS,
    RectifiedMatcher,
    batch_pairs,
    matrices,
    run,
    sources,
    write_pairs,
)

from mkpc_kaggle.data.competition import Pair, submission_problems
from mkpc_kaggle.engine import estimates
from mkpc_kaggle.engine.jobs import EstimateJob, Job, SceneJob
from mkpc_kaggle.engine.plan.state import FALLBACK, PAIR, SCENE, State
from mkpc_kaggle.engine.request import Ending, RunReport
from mkpc_kaggle.engine.workers import places
from mkpc_kaggle.engine.workers.places import LocalSite
from mkpc_kaggle.engine.workers.process import ThreadWorker
from mkpc_kaggle.engine.workers.worker import MatchRunner, do_estimates_job, scene_runner
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.reporting.run_log import read_log
from mkpc_kaggle.reporting.summary import summary, trouble
from mkpc_kaggle.scene.choose import Reason
from mkpc_kaggle.scene.sfm import Solution


def each(**changes: Any) -> Callable[[Sequence[Any]], Any]:
    """Change fields of all values of an answer."""
    return lambda answer: tuple(replace(one, **changes) for one in answer)


def fail(_: Any) -> Any:
    raise RuntimeError("injected")


ESTIMATES: dict[str, Callable[[Any], Any]] = {
    "raises": fail,
    "None": lambda _: None,
    "text": lambda _: "hello",
    "a list": list,
    "one too few": lambda answer: answer[:-1],
    "zeros": each(F=np.zeros((3, 3))),
    "NaN": each(F=np.full((3, 3), np.nan)),
    "infinite": each(F=np.full((3, 3), np.inf)),
    "another shape": each(F=np.eye(4)),
    "rank 3": each(F=np.eye(3)),
    "rank 1": each(F=np.diag([1.0, 0, 0])),
    "complex": each(F=FALLBACK_FUNDAMENTAL * 1j),
    "no array": each(F=FALLBACK_FUNDAMENTAL.tolist()),
    "other points": each(points=("lie",)),
    "huge counts": lambda answer: tuple(
        replace(one, inliers=(10**30,) * len(one.inliers)) for one in answer
    ),
    "fewer counts": each(inliers=()),
    "a time that is not finite": each(seconds=float("nan")),
    "a negative time": each(seconds=-1e9),
}


def lying(lie: Callable[[Any], Any], job: Job) -> Any:
    answer = do_estimates_job(job)
    return lie(answer) if isinstance(job, EstimateJob) else answer


def estimates_by(
    monkeypatch: pytest.MonkeyPatch, lie: Callable[[Any], Any], *, everywhere: bool
) -> None:
    """Let the workers of estimates lie; ``everywhere``: and the other processes that try them."""
    make = partial(runner, partial(lying, lie))
    monkeypatch.setattr(places, "estimates_runner", lambda **_: make())
    elsewhere = make if everywhere else scene_runner
    worker = partial(ThreadWorker, "elsewhere", elsewhere)
    monkeypatch.setattr(LocalSite, "scene_worker", lambda site: worker(site.ring))
    monkeypatch.setattr(places, "RESTART_PAUSE_S", 0.0)


def test_the_faults_of_workers_of_estimates_cost_no_f(tmp_path, monkeypatch):
    pairs = write_pairs(tmp_path / "images", 2)
    expected = matrices(run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "undisturbed"))
    for number, (name, lie) in enumerate(ESTIMATES.items()):
        estimates_by(monkeypatch, lie, everywhere=False)
        report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / str(number))
        assert matrices(report) == expected, name
        assert (report.ending, trouble(report)) == (Ending.COMPLETE, ""), name
        assert report.faults, name


@pytest.mark.parametrize("lie", ESTIMATES.values(), ids=ESTIMATES)
def test_estimates_that_no_worker_can_make_end_the_run_as_failed_after_few_tries(
    tmp_path, monkeypatch, lie
):
    pairs = write_pairs(tmp_path / "images", 5)
    estimates_by(monkeypatch, lie, everywhere=True)
    jobs = count_jobs(monkeypatch)
    output = tmp_path / "submission.csv"
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work", output=output)
    assert report.ending is Ending.WITH_FAILURES
    assert trouble(report).startswith("the run failed: 5 of 5 pairs got no F because of errors")
    assert "not reached" not in summary(report)
    # The rest of the run goes on, and the file is valid.
    assert report.units_run == 15
    assert submission_problems(output, [pair.id for pair in pairs]) == []
    # Three for each pair would be 15. Two pairs that were lost everywhere are enough.
    assert len(jobs) < 15
    # The journal says the same.
    assert trouble(read_log(tmp_path / "work")) == trouble(report)
    monkeypatch.undo()
    again = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    assert (again.ending, again.units_run, again.estimated) == (Ending.COMPLETE, 0, 5)


def count_jobs(monkeypatch: pytest.MonkeyPatch) -> list[EstimateJob | None]:
    jobs: list[EstimateJob | None] = []
    job_of = estimates.Estimating.job

    def noted(self: estimates.Estimating, due: Sequence[int], **more: Any) -> EstimateJob | None:
        jobs.append(job_of(self, due, **more))
        return jobs[-1]

    monkeypatch.setattr(estimates.Estimating, "job", noted)
    return jobs


MATCHES: dict[str, Callable[[Any], Any]] = {
    "None": lambda _: None,
    "one too few": lambda answer: answer[:-1],
    "no images": each(images=()),
    "images exchanged": lambda answer: tuple(
        replace(one, images=one.images[::-1]) for one in answer
    ),
    "a time that is not finite": lambda answer: units(answer, match_seconds=float("nan")),
    "a negative time": lambda answer: units(answer, match_seconds=-1e6),
    "a number that JSON has not": lambda answer: units(answer, keypoints=np.int64(5)),
    "a unit twice": lambda answer: tuple(replace(one, results=one.results * 2) for one in answer),
    "points that are not finite": lambda answer: tuple(
        replace(one, results=tuple(map(with_nan, one.results))) for one in answer
    ),
}


def units(answer: Any, **changes: Any) -> Any:
    return tuple(replace(one, results=each(**changes)(one.results)) for one in answer)


def with_nan(found: Any) -> Any:
    matches = replace(found.matches, points0=found.matches.points0 * np.nan)
    return replace(found, matches=matches)


@pytest.mark.parametrize("lie", MATCHES.values(), ids=MATCHES)
def test_a_wrong_answer_about_matches_costs_one_more_try(tmp_path, monkeypatch, lie):
    pairs = write_pairs(tmp_path / "images", 2)
    expected = matrices(run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "undisturbed"))
    truth = MatchRunner.__call__
    lies = iter([lie])

    def answer(self: MatchRunner, job: Job) -> Any:
        return next(lies, lambda right: right)(truth(self, job))

    monkeypatch.setattr(MatchRunner, "__call__", answer)
    monkeypatch.setattr(places, "RESTART_PAUSE_S", 0.0)
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    assert [("wrong answer" in fault) for fault in report.faults] == [True]
    assert report.ending is Ending.COMPLETE
    assert matrices(report) == expected


def choices(**changes: Any) -> Callable[[Solution], Solution]:
    return lambda found: replace(found, choices=each(**changes)(found.choices))


SCENES: dict[str, Callable[[Any], Any]] = {
    "None": lambda _: None,
    "one choice too few": lambda found: replace(found, choices=found.choices[:-1]),
    "zeros": choices(F=np.zeros((3, 3)), reason=Reason.SCENE),
    "NaN": choices(F=np.full((3, 3), np.nan), reason=Reason.SCENE),
}


@pytest.mark.parametrize("lie", SCENES.values(), ids=SCENES)
def test_a_wrong_answer_about_a_scene_costs_the_scene_alone(tmp_path, monkeypatch, lie):
    def make(job: SceneJob) -> Any:
        return lie(choose_scene_for_all_but_the_first(job))

    scenes_by(monkeypatch, make)
    monkeypatch.setattr(places, "RESTART_PAUSE_S", 0.0)
    pairs = batch_pairs(tmp_path / "images")
    recipe = replace(THREE_UNITS, scene=SceneConfig())
    report = run(pairs, recipe, RectifiedMatcher(), tmp_path / "work")
    assert report.ending is Ending.WITH_FAILURES
    assert "wrong answer" in report.scenes[0].failure
    assert sources(report) == ["pair"] * 6


def test_no_matrix_that_the_competition_refuses_reaches_the_submission(tmp_path):
    versions: list[tuple[Any, Any]] = []

    def spoil(state: State) -> None:
        # Whatever put it there
        state.own[0] = 0.0
        state.own[1, 2, 2] = np.nan
        state.by_scene[2] = np.inf
        state.scene_source[2] = SCENE
        versions.append((state.fundamentals, state.sources))

    report = spoiled(tmp_path, spoil)
    written, origins = versions[-1]
    assert origins.tolist() == [FALLBACK, FALLBACK, FALLBACK, PAIR]
    assert [np.array_equal(F, FALLBACK_FUNDAMENTAL) for F in written] == [True] * 3 + [False]
    assert sources(report) == ["fallback"] * 3 + ["pair"]


def spoiled(home: Path, spoil: Callable[[State], None]) -> RunReport:
    pairs: list[Pair] = write_pairs(home / "images", 4)
    return run(pairs, THREE_UNITS, RectifiedMatcher(), home / "work", publish=spoil)


def test_the_fallback_has_one_form(tmp_path):
    # No match at all: the estimate fails, with a fallback of unit norm.
    pairs = write_pairs(tmp_path / "images", 2)
    versions = []
    matcher = RectifiedMatcher(matches=lambda _: 0)
    publish = lambda state: versions.append(state.fundamentals)  # noqa: E731
    run(pairs, THREE_UNITS, matcher, tmp_path / "work", publish=publish)
    for version in versions:
        assert np.array_equal(version, [FALLBACK_FUNDAMENTAL] * 2)
