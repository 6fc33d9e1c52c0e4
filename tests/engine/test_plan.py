"""The plan's decisions, and the engine on a virtual clock."""

import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from statistics import mean, median

import numpy as np
import pytest
from rectified import SECOND, SWEEP, THIRD, THREE_UNITS
from simulator import (
    Scenario,
    SimulatedSite,
    SimulatedWorker,
    VirtualClock,
    memory_journal,
    random_scenario,
    simulate,
    switch_off,
    without_records,
)

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.engine import Engine
from mkpc_kaggle.engine.jobs import Cause, Failure, MatchJob, Outcome, Phase
from mkpc_kaggle.engine.plan import Plan
from mkpc_kaggle.engine.request import Ending, Request
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Unit

DIED = Failure(Cause.DIED, "signal SIGKILL")
UNITS = THREE_UNITS.units


@dataclass
class Pairs:
    """The part of a :class:`State` that a plan looks at."""

    had: np.ndarray
    rows: int
    inliers: np.ndarray = field(init=False)
    unreadable: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.inliers, self.unreadable = np.zeros(len(self.had), int), np.zeros(len(self.had), bool)

    @property
    def has_row(self) -> np.ndarray:
        return np.arange(len(self.had)) < self.rows


def plan_of(
    count: int = 40,
    limit: float = math.inf,
    extra: int = 0,
    had: Sequence[Sequence[Unit]] = (),
    minibatch: int = 1,
) -> Plan:
    """A plan in which each unit is known to take a second; ``had``: the units that the first pairs have had."""
    pairs = Pairs(np.zeros((count + extra, len(UNITS)), bool), count)
    for index, units in enumerate(had):
        pairs.had[index, [UNITS.index(unit) for unit in units]] = True
    explanations: list[str] = []
    budget = Budget(0.0, limit, lambda: 0.0)
    announced: list[str] = []
    plan = Plan(UNITS, pairs, range(count + extra), budget, explanations.append, announced.append, minibatch)
    plan.explanations, plan.announced = explanations, announced
    return plan


def finish(plan: Plan, job: MatchJob, inliers: Callable[[int], int] = lambda _: 50) -> float:
    """Every unit of a job took a second. Return the seconds of the job."""
    found = tuple(UnitResult(unit, Matches.empty(), 0.0, 1.0) for unit in job.units)
    for index in job.indices:
        plan.state.had[index, [UNITS.index(unit) for unit in job.units]] = True
        plan.state.inliers[index] = inliers(index)
    plan.on_result(job, [Outcome(index, found=found) for index in job.indices])
    return float(len(job.indices) * len(found))


def jobs_of(
    plan: Plan,
    fails: Callable[[MatchJob], Failure | None] = lambda _: None,
    inliers: Callable[[int], int] = lambda _: 50,
) -> Iterator[MatchJob]:
    """All jobs of a worker, each of which comes back, or is lost, before the next is planned."""
    now = 0.0
    while (job := plan.next(now)) is not None:
        yield job
        failure = fails(job)
        if failure is None:
            now += finish(plan, job, inliers)
        else:
            now += 1.0
            plan.on_failure(job, failure)


def learnt(plan: Plan, unit: Unit, seconds: float = 1.0) -> Plan:
    plan.costs.observe(unit.name, seconds)
    plan._look()
    return plan


def explained(texts: Iterable[object], text: str) -> bool:
    return any(text in str(explanation) for explanation in texts)


def test_the_phases_follow_each_other_and_every_pair_has_every_unit():
    plan = plan_of(extra=3)
    phases = [job.phase for job in jobs_of(plan)]
    assert phases == sorted(phases, key=list(Phase).index)
    assert plan.is_complete
    assert plan.state.had[:40].all()
    assert plan.state.had[40:].sum(1).tolist() == [1, 1, 1]


def test_no_pair_is_in_two_jobs_at_a_time_and_a_cost_is_learnt_from_one_unit():
    plan = plan_of(9)
    jobs = []
    while (job := plan.next(0.0)) is not None:
        jobs.append(job)
    assert sorted(index for job in jobs for index in job.indices) == list(range(9))
    assert {job.units for job in jobs} == {(SWEEP,)}


def test_a_minibatch_has_pairs_that_lack_the_same_units():
    plan = plan_of(9, had=[(SWEEP,), (SWEEP, THIRD), (SWEEP,)], minibatch=4)
    for unit in UNITS:
        learnt(plan, unit)
    jobs = [plan.next(0.0) for _ in range(4)]
    assert [job.indices for job in jobs] == [(3, 4, 5, 6), (7, 8), (0, 2), (1,)]
    assert [job.units for job in jobs] == [(SWEEP,), (SWEEP,), (THIRD, SECOND), (SECOND,)], "stage 1 first"


def test_a_lost_job_comes_back_as_single_units_and_a_unit_lost_twice_is_skipped_for_its_pair():
    plan, lost = plan_of(3), []

    def fails(job: MatchJob) -> Failure | None:
        if job.indices == (1,) and THIRD in job.units:
            lost.append((job.units, job.is_retry))
            return DIED
        return None

    list(jobs_of(plan, fails))
    assert lost == [((THIRD, SECOND), False), ((THIRD,), True), ((THIRD,), True)]
    assert plan.losses.skipped == {(1, THIRD.name): DIED}
    assert explained(plan.explanations, "1:rectified@160 is skipped on pair 1 (the worker died: signal SIGKILL)")
    assert plan.is_complete
    assert plan.state.had.tolist() == [[True] * 3, [True, True, False], [True] * 3]


def test_a_unit_that_never_ran_is_skipped_on_all_pairs_after_two():
    plan, lost = plan_of(200), []

    def fails(job: MatchJob) -> Failure | None:
        if SECOND not in job.units:
            return None
        lost.append(job)
        return DIED

    list(jobs_of(plan, fails))
    assert len(lost) == 4, "two tries on each of two pairs"
    assert plan.unusable.tolist() == [False, True, False]
    assert plan.is_complete
    assert explained(plan.explanations, f"{SECOND.name} is skipped on all pairs: it never ran")


def test_a_first_unit_that_never_runs_leaves_the_sweep_to_the_next_of_stage_1():
    plan = plan_of(5)
    jobs = list(jobs_of(plan, lambda job: DIED if SWEEP in job.units else None))
    assert [job.units[0] for job in jobs if job.phase is Phase.SWEEP][4:] == [THIRD] * 5


def test_what_a_jobs_own_deadline_cut_off_is_planned_again():
    plan = learnt(plan_of(1, limit=1000.0, had=[(SWEEP,)]), SECOND)
    learnt(plan, THIRD)
    job = plan.next(0.0)
    assert job.units == (THIRD, SECOND)
    plan.state.had[0, 2] = True
    plan.on_result(job, [Outcome(0, found=(UnitResult(THIRD, Matches.empty(), 0.0, 1.0),))])
    assert plan.next(7.0).units == (SECOND,)


@pytest.mark.parametrize(
    ("limit", "fit"), [(math.inf, "there is no time limit"), (120.0, "2 of 3 units fit in the")]
)
def test_after_the_sweep_the_user_is_told_once_how_many_units_fit(limit, fit):
    plan = plan_of(limit=limit)
    for job in jobs_of(plan):
        assert not plan.announced or job.phase is not Phase.SWEEP
    assert [fit in line for line in plan.announced] == [True]
    assert "not measured" not in plan.announced[0]


@pytest.mark.parametrize("reserve", [0.0, 10.0])
def test_a_unit_begins_only_if_it_ends_before_the_time_reserved_for_scenes(reserve):
    plan = plan_of(3, limit=100.0)
    for unit in UNITS:
        learnt(plan, unit)
    plan.reserve = 10.0
    now = plan.stop - 0.5
    plan.reserve = reserve
    assert (plan.next(now) is None) == bool(reserve)


def test_units_that_do_not_fit_for_all_go_to_the_weakest_pairs_in_the_time_left():
    plan = plan_of(60, limit=100.0)
    jobs = list(jobs_of(plan, inliers=lambda index: index))
    filled = [index for job in jobs if job.phase is Phase.FILL for index in job.indices]
    assert explained(plan.explanations, "deepen: all units on all pairs would take")
    assert explained(plan.explanations, "fill: all units on all pairs would take")
    assert filled == sorted(filled)
    assert filled[0] < 3
    assert not plan.is_complete


def test_pairs_for_the_scenes_alone_take_a_tenth_of_the_time_left_at_most():
    plan = plan_of(6, limit=100.0, extra=80)
    jobs = list(jobs_of(plan))
    assert plan.state.had[:6].all()
    assert {job.units for job in jobs if job.phase is Phase.CONNECT} == {(SWEEP,)}
    had = np.flatnonzero(plan.state.had[6:].any(1)).tolist()
    assert had == list(range(len(had))), "the most useful first"
    assert 5 < len(had) < 10
    assert plan.is_complete


# The engine on a virtual clock


def test_two_workers_fit_more_units_than_one():
    plan, fits = plan_of(40, limit=100.0), []
    finish(plan, MatchJob(Phase.SWEEP, (0,), UNITS, (1.0,) * 3, math.inf))
    for plan.workers in (1, 2):
        fits.append(plan.fit(0.0))
    assert fits[0] < fits[1] == 3


def test_more_time_never_means_fewer_units():
    runs = [simulate(Scenario(40, (1.0, 1.0, 1.0), 1, limit, misses=0)) for limit in (40.0, 80.0, 120.0, 999.0)]
    units = [sum(len(record.units) for record in ran.report.records) for ran in runs]
    assert units == sorted(units)
    assert 0 < units[0] < 40 < units[1] < units[-1] == 120
    assert all(ran.late == ran.lost == 0 for ran in runs)


def test_random_runs_are_never_late_never_lose_a_row_and_use_their_time():
    runs = [without_records(simulate(random_scenario(seed, pairs=150))) for seed in range(8)]
    assert max(run.late for run in runs) == 0
    assert sum(run.lost for run in runs) == 0
    fit = [run for run in runs if run.scenes_fit]
    assert sum(run.missed for run in fit) <= 0.03 * sum(run.scenario.batches for run in fit)
    used = [run.utilisation for run in runs if run.work_left]
    assert median(used) > 0.97
    assert mean(used) > 0.94


ABLATIONS = {  # a scenario that each mechanism of the plan serves
    "reserve for scenes": Scenario(600, (1.0,), 1, 500.0, warm_up=1, batches=2, scene_seconds=0.05),
    "margin of scenes": Scenario(400, (1.0,), 1, 500.0, warm_up=1, batches=8, scene_seconds=0.18),
    "margin of units": Scenario(150, (1.0,) * 4, 1, 500.0, warm_up=1, spread=1.0),
    "connect share": Scenario(100, (1.0,) * 3, 1, 300.0, warm_up=1, batches=2, pairs_per_image=6.0),
    "short jobs": Scenario(100, (1.0,) * 8, 2, 300.0, warm_up=1, spread=0.5, crashes=0.01),
    "patience": Scenario(150, (1.0, 1.0), 1, 400.0, warm_up=1, hangs=0.01, misses=0, seed=1),
    "second try": Scenario(100, (1.0,), 1, 600.0, warm_up=1, crashes=0.05),
    "end of tries": Scenario(100, (0.5, 1.0, 1.0), 1, 300.0, warm_up=1, never="m1"),
}


@pytest.mark.parametrize("mechanism", ABLATIONS)
def test_a_mechanism_that_is_off_costs_units_or_scenes(monkeypatch, mechanism):
    def gained() -> tuple[int, int]:
        ran = simulate(ABLATIONS[mechanism])
        return -ran.missed, sum(len(record.units) for record in ran.report.records)

    whole = gained()
    switch_off(mechanism, monkeypatch.setattr)
    assert gained() < whole


def test_planning_a_job_does_not_take_much_longer_for_many_pairs():
    seconds_per_pair = []
    for count in (100, 1_000):
        start = time.thread_time()  # whatever else the machine does
        simulate(Scenario(count, (0.1, 0.5, 0.5), 2, count))
        seconds_per_pair.append((time.thread_time() - start) / count)
    few, many = seconds_per_pair
    assert many < 5 * few


def test_scenes_are_done_in_parallel_with_matching_and_the_last_in_the_time_reserved_for_it():
    ran = simulate(Scenario(600, (0.5, 1.0, 1.0), 1, 1200.0, warm_up=1, batches=6, scene_seconds=0.3))
    assert ran.late == ran.lost == ran.missed == 0
    assert ran.work_left
    assert len({scene.batch for scene in ran.scenes}) == 6
    assert sum(scene.begun + scene.seconds < ran.last_job for scene in ran.scenes) >= 5
    assert ran.utilisation > 0.95


def test_a_scene_that_hangs_is_ended_and_the_others_have_their_turn():
    ran = simulate(Scenario(900, (0.5, 1.0), 1, 7200.0, batches=9, scene_faults=0.4, seed=3))
    assert any(scene.seconds == math.inf for scene in ran.scenes)
    assert ran.late == ran.lost == ran.missed == 0
    assert any("the worker hung" in fault for fault in ran.report.faults)


@pytest.mark.parametrize("moment", [50, 450, 850])
def test_a_run_killed_at_any_moment_leaves_no_scene_out_of_date_when_it_resumes(moment):
    scenario = Scenario(300, (0.5, 1.0), 1, 3600.0, batches=3, pairs_per_image=1.0, misses=0)
    journal = memory_journal()
    simulate(scenario, journal, until=moment)
    ran = simulate(scenario, journal)
    assert ran.report.ending is Ending.COMPLETE
    assert ran.stale == set()
    assert sum(len(record.units) for record in ran.report.records) == 600


def test_time_reserved_for_scenes_is_used_for_units_when_they_need_less():
    ran = simulate(Scenario(600, (0.1, 0.2, 0.3), 1, 280.0, warm_up=1, batches=1))
    assert ran.work_left
    assert ran.report.seconds > 275.0


def test_a_job_of_an_earlier_request_is_saved_before_the_next_request_begins():
    scenario = Scenario(10, (10.0,), 1, 1000.0, spread=0, misses=0, warm_up=0)
    clock, nothing = VirtualClock(), Request((), scenario.recipe, scenario.settings)
    time = Budget(0.0, scenario.limit, clock)
    site = SimulatedSite(scenario, clock, time.stop_units)
    pairs = [Pair(str(n), "", str(n), "b") for n in range(10)]
    with Engine(nothing, site, memory_journal(), time, interrupt=threading.Event(), progress=False) as engine:
        engine.ask(replace(nothing, pairs=pairs), share=0.05)  # it ends amid the fifth pair
        assert engine.state.had.sum() == 5
        engine.ask(replace(nothing, pairs=pairs[4:6]))
        report = engine.report()
    assert (report.ending, report.units_run) == (Ending.COMPLETE, 6), "five, and the sixth"


def test_scenes_that_never_begin_are_named_and_the_run_ends(monkeypatch):
    monkeypatch.setattr(
        SimulatedSite, "scene_worker", lambda site: SimulatedWorker(site, site.reconstruct, math.inf)
    )
    ran = simulate(Scenario(300, (0.5, 1.0), 1, 900.0, batches=3, misses=0))
    assert ran.late == 0
    assert explained(ran.report.faults, "scenes: the worker hung: no answer for ")
    assert all(scene.failure for scene in ran.report.scenes)
