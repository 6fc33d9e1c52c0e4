"""The plan's decisions, and the engine on a virtual clock."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from statistics import mean, median
from typing import ClassVar

import numpy as np
import pytest
from rectified import SECOND, SWEEP, THIRD, THREE_UNITS
from simulator import (
    Scenario,
    SimulatedSite,
    SimulatedWorker,
    random_scenario,
    simulate,
    without_tables,
)
from store_room import keys_of

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine import plan as plan_module
from mkpc_kaggle.engine.budget import Budget, Costs
from mkpc_kaggle.engine.plan import Crew, Plan
from mkpc_kaggle.engine.request import Cause, Ending, Failure, MatchPlan, Request
from mkpc_kaggle.engine.state import CONNECT, FILL, NEVER, RAISED, State
from mkpc_kaggle.engine.state import SWEEP as SWEEPING
from mkpc_kaggle.recipe import SceneConfig, Unit

DIED = Failure(Cause.DIED, "signal SIGKILL")


UNITS = THREE_UNITS.units


WITH_SCENE = replace(THREE_UNITS, scene=SceneConfig(pairs_per_image=0))


class Planned:
    """A state without a store, and workers whose units take a second each: what the plan gives them."""

    def __init__(
        self,
        count: int = 40,
        limit: float = math.inf,
        extra: int = 0,
        had: Sequence[Sequence[Unit]] = (),
        minibatch: int = 1,
        recipe=THREE_UNITS,
    ) -> None:
        """``had`` are the units that the first pairs have had. Extra pairs are for scenes alone."""
        pairs = []
        for number in range(count + extra):
            name = f"{number:03d}"  # its order as text is that of the numbers
            pairs.append(Pair(name, "", f"{name}.png", f"{name}b.png"))
        self.state = State(Request(pairs, recipe, keys_of(recipe)), {})
        self.state.rows = count
        self.costs = Costs()
        self.budget = Budget(0.0, limit, lambda: 0.0)
        self.crew = Crew(minibatch=minibatch)
        for index, units in enumerate(had):
            self.have(index, units)

    def have(self, index: int, units: Iterable[Unit], matches: int = 50) -> None:
        for unit in units:
            self.state.done[index, UNITS.index(unit)] = True
            self.state.matches[index, UNITS.index(unit)] = matches

    def learn(self, *units: Unit) -> None:
        for unit in units:
            self.costs.observe(unit.name, 1.0)

    def plan(self, now: float = 0.0, lost: int = 0) -> Plan:
        return Plan(self.state, self.costs, self.budget, self.crew, now, lost)

    def next(self, now: float = 0.0) -> MatchPlan | None:
        """The next job of matching, which is under way then."""
        job = self.plan(now).match
        if job is not None:
            self.state.busy[job.pairs] = job.phase
        return job

    def finish(self, job: MatchPlan, inliers: Callable[[int], int] = lambda _: 50) -> float:
        """Every unit of a job took a second. Return the seconds of the job."""
        self.state.busy[job.pairs] = NEVER
        for index in job.pairs:
            self.have(index, [UNITS[unit] for unit in job.units])
            self.state.inliers[index] = inliers(index)
            self.learn(*(UNITS[unit] for unit in job.units))
        return float(len(job.pairs) * len(job.units))

    def jobs(self, inliers: Callable[[int], int] = lambda _: 50) -> Iterator[MatchPlan]:
        """All jobs of a worker, each of which comes back before the next is planned."""
        now = 0.0
        while (job := self.next(now)) is not None:
            yield job
            now += self.finish(job, inliers)

    @property
    def is_complete(self) -> bool:
        return not self.state.missing[: self.state.rows].any()


def explained(texts: Iterable[object], text: str) -> bool:
    return any(text in str(explanation) for explanation in texts)


def test_the_phases_follow_each_other_and_every_pair_has_every_unit():
    run = Planned(extra=3)
    phases = [job.phase for job in run.jobs()]
    assert phases == sorted(phases)
    assert run.is_complete
    # Extra pairs serve the scene only: the sweep's unit is enough.
    assert run.state.done[40:].sum(1).tolist() == [1, 1, 1]


def test_the_plan_has_no_memory_and_changes_nothing():
    run = Planned(9, limit=100.0, extra=3, had=[(SWEEP,), (SWEEP, SECOND)])
    run.learn(*UNITS)
    arrays = {k: v for k, v in vars(run.state).items() if isinstance(v, np.ndarray)}
    before = {name: array.copy() for name, array in arrays.items()}
    # A plan that is not carried out, because no worker is idle, must leave no trace.
    first, second = run.plan(), run.plan()
    assert (first.match, first.estimates, first.scenes) == (
        second.match,
        second.estimates,
        second.scenes,
    )
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(run.state, name), value)


def test_no_pair_is_in_two_jobs_at_a_time_and_a_cost_is_learnt_from_one_unit():
    run = Planned(9)
    # As with nine workers: no job has returned, so no cost is known.
    jobs = []
    while (job := run.next()) is not None:
        jobs.append(job)
    assert sorted(index for job in jobs for index in job.pairs) == list(range(9))
    assert [job.units for job in jobs] == [[0]] * 9
    assert jobs[0].upcoming == [1]


def test_a_minibatch_has_pairs_that_lack_the_same_units():
    run = Planned(9, had=[(SWEEP,), (SWEEP, SECOND), (SWEEP,)], minibatch=4)
    run.learn(*UNITS)
    jobs = [run.next() for _ in range(4)]
    # One tensor has the views of one unit, so pairs with other missing units wait.
    assert [job.pairs for job in jobs] == [[3, 4, 5, 6], [7, 8], [0, 2], [1]]
    assert [job.units for job in jobs] == [[0], [0], [1, 2], [2]]


def test_near_the_end_a_minibatch_gets_as_small_as_the_time_that_is_left():
    run = Planned(30, limit=100.0, had=[(SWEEP,)] * 30, minibatch=8)
    run.learn(*UNITS)
    sizes = [
        len(run.plan(run.plan().left - left).match.pairs)
        for left in (50.0, 9.5, 8.5, 5.5, 1.5)
    ]
    assert sizes == [8, 8, 8, 5, 1]


def test_a_crop_waits_for_the_units_of_stage_1_before_it():
    run = Planned(3, limit=100.0, recipe=replace(THREE_UNITS, units=(SWEEP, THIRD, SECOND)))
    run.state.done[:, 0] = True
    run.costs.observe(SWEEP.name, 1.0)
    run.costs.observe(SECOND.name, 1.0)
    run.costs.observe(THIRD.name, 1000.0)
    assert run.next() is None, "there is no time for the unit before the crop"
    run.state.losses[0, 1] = RAISED
    assert run.next().pairs == [0], "which was given up on this pair"


def test_a_suspect_is_alone_in_its_job_and_comes_last():
    run = Planned(3, had=[(SWEEP,)] * 3)
    run.learn(*UNITS)
    run.state.losses[0, 1] = 1
    run.state.losses[1, 2] = RAISED
    jobs = [run.next() for _ in range(3)]
    # Another loss then has one cause. A matcher that raised makes no suspect.
    assert [(job.pairs, job.units) for job in jobs] == [
        ([1], [1]),
        ([2], [1, 2]),
        ([0], [1]),
    ]


def test_a_place_that_lost_jobs_continues_elsewhere_with_one_unit():
    run = Planned(9, had=[(SWEEP,)] * 9, minibatch=8)
    run.learn(*UNITS)
    jobs = [run.plan(lost=lost).match for lost in range(4)]
    # Neighbours share an image.
    assert [job.pairs[0] for job in jobs] == [0, 3, 6, 6]
    assert [len(job.units) * len(job.pairs) for job in jobs[1:]] == [1, 1, 1]
    # A photograph that is decoded ahead may be the cause of the losses.
    assert [len(job.upcoming) > 0 for job in jobs] == [True, False, False, False]


def test_a_part_of_many_due_estimates_is_handed_out_and_nothing_forgets_the_others(
    monkeypatch,
):
    monkeypatch.setattr(plan_module, "MAX_DUE", 3)
    run = Planned(count=8, had=[UNITS] * 8)
    due = []
    while work := run.plan().estimates:
        assert len(work) <= 3
        due += work
        run.state.estimating[work] = True
    assert sorted(due) == list(range(8))


@pytest.mark.parametrize("reserve", [0, 100])
def test_a_unit_begins_only_if_it_ends_before_the_time_reserved_for_estimates_and_scenes(
    reserve,
):
    run = Planned(3, limit=100.0, had=[(SWEEP,)] * 3)
    run.learn(*UNITS)
    # Three estimates of 5 s are more than the 10 s before the end.
    for _ in range(reserve):
        run.costs.observe("estimate", 5.0)
    now = run.budget.stop_units - 10.0
    assert (run.next(now) is None) == bool(reserve)


def test_units_that_do_not_fit_for_all_go_to_the_weakest_pairs_in_the_time_left():
    run = Planned(60, limit=100.0)
    # The number of inliers is the pair's index, so the first pairs are the weakest.
    filled = []
    for job in run.jobs(inliers=lambda index: index):
        if job.phase == FILL:
            filled += job.pairs
    assert filled == sorted(filled)
    assert filled[0] < 3
    assert not run.is_complete


def test_pairs_for_the_scenes_alone_take_a_tenth_of_the_time_left_at_most():
    run = Planned(6, limit=100.0, extra=80)
    jobs = list(run.jobs())
    assert {tuple(job.units) for job in jobs if job.phase == CONNECT} == {(0,)}
    had = np.flatnonzero(run.state.done[6:].any(1)).tolist()
    assert had == list(range(len(had))), "the most useful first"
    assert 5 < len(had) < 10
    assert run.is_complete


def test_a_first_scene_waits_for_the_units_that_fit_and_a_later_scene_for_all():
    run = Planned(6, limit=1000.0, had=[(SWEEP, SECOND)] * 6, recipe=WITH_SCENE)
    run.state.estimated[:] = run.state.has_f[:] = True
    run.learn(SWEEP, SECOND)
    # The third unit does not fit for all pairs; many measurements, so that the forecast is certain.
    for _ in range(1000):
        run.costs.observe(THIRD.name, 400.0)
    assert run.plan().scenes == [(0, 0)]
    run.state.made[0, 0] = True
    assert run.plan().scenes == []
    run.crew = replace(run.crew, matchers=0)
    run.state.losses[:, 2] = RAISED
    assert run.plan().scenes == [(0, 0)]


def test_a_first_scene_does_not_wait_for_a_job_that_hangs_until_the_end():
    run = Planned(6, limit=1000.0, had=[UNITS] * 5, recipe=WITH_SCENE)
    run.state.estimated[:] = run.state.has_f[:] = True
    run.learn(*UNITS)
    run.state.busy[5] = SWEEPING
    stop = run.plan().left
    assert run.plan(stop - 1.0).scenes == []
    assert run.plan(stop).scenes == [(0, 0)]
    run.state.made[0, 0] = True  # a later scene needs all points
    assert run.plan(stop).scenes == []


def test_scenes_do_not_wait_for_estimates_that_nobody_makes():
    run = Planned(6, limit=1000.0, had=[UNITS] * 6, recipe=WITH_SCENE)
    assert run.plan().scenes == []
    run.crew = replace(run.crew, estimators=0)
    assert run.plan().scenes == [(0, 0)]


def units_of(ran):
    """The number of results of units of all pairs."""
    return int((ran.report.units["failure"] == "").sum())


def test_random_runs_are_never_late_never_lose_a_row_and_use_their_time():
    runs = [without_tables(simulate(random_scenario(seed, pairs=150))) for seed in range(5)]
    assert max(run.late for run in runs) == 0
    assert sum(run.lost for run in runs) == 0
    assert [run.wrongly_closed for run in runs if run.wrongly_closed] == []
    # The cost of a scene may rise after the last measurement, and then its time is too short.
    fit = [run for run in runs if run.scenes_fit]
    batches = sum(run.scenario.batches for run in fit)
    assert sum(run.missed for run in fit) <= 0.03 * batches
    # A run that finished early used what it needed.
    used = [run.utilisation for run in runs if run.work_left]
    assert median(used) > 0.97
    assert mean(used) > 0.94


def test_planning_a_job_does_not_take_much_longer_for_many_pairs():
    seconds_per_pair = []
    for count in (50, 500):
        # Of this thread, so that other load does not count
        start = time.thread_time()
        simulate(Scenario(count, (0.1, 0.5, 0.5), 2, count))
        seconds_per_pair.append((time.thread_time() - start) / count)
    # A plan that looks at all pairs for each job would take ten times as long a pair.
    few, many = seconds_per_pair
    assert many < 5 * few


def test_scenes_are_done_in_parallel_with_matching_and_the_last_in_the_time_reserved_for_it():
    ran = simulate(
        Scenario(600, (0.5, 1.0, 1.0), 1, 1200.0, warm_up=1, batches=6, scene_seconds=0.3)
    )
    assert ran.late == ran.lost == ran.missed == 0
    assert ran.work_left
    assert len({scene.batch for scene in ran.scenes}) == 6
    # The last one may wait for the last pairs.
    early = [scene for scene in ran.scenes if scene.begun + scene.seconds < ran.last_job]
    assert len(early) >= 5
    assert ran.utilisation > 0.95


def test_a_scene_that_hangs_is_ended_and_the_others_have_their_turn():
    ran = simulate(Scenario(300, (0.5, 1.0), 1, 7200.0, batches=9, scene_faults=0.4, seed=3))
    assert any(scene.seconds == math.inf for scene in ran.scenes)
    assert ran.late == ran.lost == ran.missed == 0
    assert any("the worker hung" in fault for fault in ran.report.about.faults)


def test_scenes_that_never_begin_are_named_and_the_run_ends(monkeypatch):
    def never_ready(site):
        return SimulatedWorker(site, site.reconstruct, math.inf)

    monkeypatch.setattr(SimulatedSite, "scene_worker", never_ready)
    ran = simulate(Scenario(300, (0.5, 1.0), 1, 900.0, batches=3, misses=0))
    assert ran.late == 0
    assert explained(ran.report.about.faults, "scenes 0: the worker hung: no answer for ")
    assert ran.report.scenes["failure"].all()


class FailingSite(SimulatedSite):
    """Loses jobs with the third unit of the third pair."""

    lost: ClassVar[list[list[str]]] = []

    def match(self, warm, job):
        names = [unit.name for unit in job.units]
        if 2 in job.indices and "1:m2@100" in names:
            self.lost.append(names)
            return 1.0, DIED, 1.0
        return super().match(warm, job)


def test_a_lost_job_comes_back_as_single_units_and_a_unit_lost_twice_is_skipped_for_its_pair(
    monkeypatch,
):
    monkeypatch.setattr("simulator.SimulatedSite", FailingSite)
    FailingSite.lost = []
    ran = simulate(Scenario(4, (1.0,) * 3, 1, math.inf, spread=0, misses=0))
    # First with the pair's other unit; then alone
    assert FailingSite.lost == [["2:m1@100", "1:m2@100"], ["1:m2@100"]]
    assert ran.given_up == ((2, 2),)
    units = ran.report.units
    (reason,) = units["failure"][units["unit"] == "1:m2@100"][2:3]
    assert reason == "the worker died: signal SIGKILL"
    assert ran.report.ending is Ending.WITH_FAILURES
    assert units_of(ran) == 11


def test_a_unit_that_never_ran_is_skipped_on_all_pairs_after_two():
    ran = simulate(Scenario(200, (1.0,) * 3, 1, math.inf, misses=0, never="m1"))
    # On each pair it would cost two workers.
    assert explained(
        ran.report.about.faults, "2:m1@100 is skipped on all pairs: it never ran"
    )
    assert units_of(ran) == 400
    assert ran.closed == ()
    assert ran.report.ending is Ending.WITH_FAILURES
    assert sum("was lost" in fault for fault in ran.report.about.faults) == 1, (
        "the same text is told once"
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_photograph_that_breaks_each_of_its_pairs_costs_no_place_and_no_other_pair(seed):

    rng = np.random.default_rng(seed)
    first = int(rng.integers(0, 280))
    # Its pairs are neighbours in the visiting order.
    bad = tuple(range(first, first + 12))
    workers = int(rng.integers(1, 4))
    ran = simulate(Scenario(300, (1.0, 1.0), workers, math.inf, bad=bad, misses=0, seed=seed))
    assert ran.closed == ()
    assert {index for index, _ in ran.given_up} == set(bad)
    assert units_of(ran) == 2 * 288


def test_a_place_that_fails_is_closed_and_its_pairs_are_matched_elsewhere():
    broken = 0.1
    scenario = Scenario(
        300, (1.0, 1.0), 2, 900.0, bad_places=1, broken=broken, misses=0, bad=(0, 1)
    )
    ran = simulate(scenario)
    assert ran.closed == ("place 1",)
    # Each place lost its first job. The unit has run since, so that says nothing of it.
    assert {index for index, _ in ran.given_up} == {0, 1}
    assert units_of(ran) == 596
    # All of them: the CPU takes over.
    alone = simulate(
        replace(scenario, workers=1, fallback=True, limit=3000.0, broken=broken / 3)
    )
    assert alone.on_fallback > 0
    assert units_of(alone) == 600
