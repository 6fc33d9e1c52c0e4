"""The schedule's decisions, and the engine on a virtual clock."""

import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from statistics import mean, median

import numpy as np
import pytest
from rectified import SECOND, SWEEP, THIRD, THREE_UNITS, sources
from simulator import (
    Scenario,
    SimulatedSite,
    SimulatedWorker,
    VirtualClock,
    memory_store,
    random_scenario,
    simulate,
    switch_off,
    without_tables,
)

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.jobs import Cause, Failure, MatchJob, Phase
from mkpc_kaggle.engine.loop import Engine
from mkpc_kaggle.engine.plan import schedule
from mkpc_kaggle.engine.plan.blame import Item
from mkpc_kaggle.engine.plan.budget import Budget, Costs
from mkpc_kaggle.engine.plan.schedule import (
    Crew,
    NextWork,
    Snapshot,
    next_work,
    outlook,
    prefix_that_fits,
    upcoming_pairs,
)
from mkpc_kaggle.engine.plan.state import State
from mkpc_kaggle.engine.request import Ending, Request
from mkpc_kaggle.engine.scenes import scene_failures
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.dataframes import matrices_of
from mkpc_kaggle.engine.store.keys import Keys
from mkpc_kaggle.engine.store.layout import Layout
from mkpc_kaggle.recipe import SceneConfig, Unit
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.sfm import Solution

DIED = Failure(Cause.DIED, "signal SIGKILL")
UNITS = THREE_UNITS.units


class Run:
    """A state without a store, and workers whose units take a second each: what the schedule gives
    them.
    """

    def __init__(
        self,
        count: int = 40,
        limit: float = math.inf,
        extra: int = 0,
        had: Sequence[Sequence[Unit]] = (),
        minibatch: int = 1,
    ) -> None:
        """``had`` are the units that the first pairs have had. Extra pairs are for scenes alone."""
        pairs = []
        for number in range(count + extra):
            name = f"{number:03d}"  # its order as text is that of the numbers
            pairs.append(Pair(name, "", f"{name}.png", f"{name}b.png"))
        keys = Keys(tuple(unit.name for unit in UNITS))
        request = Request(pairs[:count], THREE_UNITS, keys)
        self.state = State(request, pairs[count:])
        self.costs = Costs()
        self.budget = Budget(0.0, limit, lambda: 0.0)
        self.crew = Crew(minibatch=minibatch)
        for index, units in enumerate(had):
            self.have(index, units)

    def have(self, index: int, units: Iterable[Unit]) -> None:
        """Give the pair points of these units; other crops make those of stage 2 out of date."""
        state = self.state
        numbers = [UNITS.index(unit) for unit in units]
        if any(UNITS[number].stage == 1 for number in numbers):
            state.current[index, state.is_crop] = False
        state.has[index, numbers] = state.current[index, numbers] = True

    def learn(self, *units: Unit) -> None:
        for unit in units:
            self.costs.observe(unit.name, 1.0)

    def next_work(self, now: float = 0.0, lost: Sequence[frozenset[Item]] = ()) -> NextWork:
        return next_work(self.state, self.costs, self.budget, self.crew, now, lost)

    def next(self, now: float = 0.0) -> MatchJob | None:
        """The next job of matching, which is under way then."""
        job = self.next_work(now).match
        if job is not None:
            self.state.begin_matching(job.indices)
        return job

    def finish(self, job: MatchJob, inliers: Callable[[int], int] = lambda _: 50) -> float:
        """Every unit of a job took a second. Return the seconds of the job."""
        self.state.end_matching(job.indices)
        for index in job.indices:
            self.have(index, job.units)
            self.state.inliers[index] = inliers(index)
            self.learn(*job.units)
        return float(len(job.indices) * len(job.units))

    def jobs(self, inliers: Callable[[int], int] = lambda _: 50) -> Iterator[MatchJob]:
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
    run = Run(extra=3)
    phases = [job.phase for job in run.jobs()]
    assert phases == sorted(phases, key=list(Phase).index)
    assert run.is_complete
    assert run.state.current[:40].all()
    # Extra pairs serve the scene only: the sweep's unit is enough.
    assert run.state.current[40:].sum(1).tolist() == [1, 1, 1]


def test_the_schedule_has_no_memory_and_changes_nothing():
    run = Run(9, limit=100.0, extra=3, had=[(SWEEP,), (SWEEP, THIRD)])
    run.learn(*UNITS)
    arrays = {k: v for k, v in vars(run.state).items() if isinstance(v, np.ndarray)}
    before = {name: array.copy() for name, array in arrays.items()}
    # A plan that is not carried out, because no worker is idle, must leave no trace.
    first = run.next_work()
    second = run.next_work()
    assert first.match.indices == second.match.indices
    assert (first.match.units, first.fit) == (second.match.units, second.fit)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(run.state, name), value)


def test_no_pair_is_in_two_jobs_at_a_time_and_a_cost_is_learnt_from_one_unit():
    run = Run(9)
    # As with nine workers: no job has returned, so no cost is known.
    jobs = []
    while (job := run.next()) is not None:
        jobs.append(job)
    indices = [index for job in jobs for index in job.indices]
    assert sorted(indices) == list(range(9))
    assert {job.units for job in jobs} == {(SWEEP,)}


def test_a_minibatch_has_pairs_that_lack_the_same_units():
    run = Run(9, had=[(SWEEP,), (SWEEP, THIRD), (SWEEP,)], minibatch=4)
    run.learn(*UNITS)
    jobs = [run.next() for _ in range(4)]
    # One tensor has the views of one unit, so pairs with other missing units wait.
    assert [job.indices for job in jobs] == [(3, 4, 5, 6), (7, 8), (0, 2), (1,)]
    units = [job.units for job in jobs]
    assert units == [(SWEEP,), (SWEEP,), (THIRD, SECOND), (SECOND,)], "stage 1 first"


def test_near_the_end_a_minibatch_gets_as_small_as_the_time_that_is_left():
    run = Run(30, limit=100.0, had=[(SWEEP,)] * 30, minibatch=8)
    run.learn(*UNITS)
    sizes = []
    for left in (50.0, 9.5, 8.5, 5.5, 1.5):
        job = run.next_work(view_of(run).stop - left).match
        sizes.append(len(job.indices))
    assert sizes == [8, 8, 8, 5, 1]


def test_upcoming_pairs_are_those_that_may_be_next():
    run = Run(9)
    job = MatchJob(Phase.SWEEP, (0, 1), (SWEEP,), (1.0,), 1.0)
    assert upcoming_pairs(run.state, job, 3) == [2, 3, 4]
    missing = np.ones(9, bool)
    missing[[0, 3, 4, 6]] = False
    assert upcoming_pairs(run.state, job, 3, missing) == [2, 5, 7]
    assert upcoming_pairs(run.state, replace(job, phase=Phase.FILL), 3) == []


def test_a_unit_that_was_lost_before_is_alone_in_its_job():
    run = Run(3, had=[(SWEEP,)] * 3)
    run.learn(*UNITS)
    run.state.tries.alone.add(("unit", 0, SECOND.name))
    suspect = run.next()
    other = run.next()
    # Another loss then has one cause. The pair's other units run first, on their own.
    assert (suspect.indices, suspect.units) == ((0,), (THIRD,))
    assert (other.indices, other.units) == ((1,), (THIRD, SECOND))


@pytest.mark.parametrize("count", range(1, 8))
def test_a_place_that_lost_any_number_of_jobs_before_the_first_answer_gets_another_pair(count):
    run = Run(10)
    lost = [frozenset([("unit", index, SWEEP.name)]) for index in range(count)]
    job = run.next_work(lost=lost).match
    assert job is not None
    assert set(job.indices).isdisjoint(range(count))


def test_a_place_that_lost_a_job_gets_no_other_unit_of_its_pair():
    run = Run(3, had=[(), (SWEEP,), (SWEEP,)], minibatch=8)
    run.learn(*UNITS)
    lost = ("unit", 0, SWEEP.name)
    run.state.tries.lose([lost], DIED)
    run.state.tries.succeed(("unit", 1, SWEEP.name))
    job = run.next_work(lost=[frozenset([lost])]).match
    # Without points of stage 1, stage 2 would look at the same whole images.
    assert job.indices == (1, 2)


def test_better_crops_come_after_all_units_that_fit_and_with_them_the_prefix_takes_longer():
    run = Run(3, limit=100.0, had=[(SWEEP, SECOND)] * 3)
    run.learn(*UNITS)
    view = view_of(run)
    assert prefix_that_fits(view) == 3
    # There is time for the third unit of three pairs, and for new crops.
    assert view.left > 2 * 3 * 1.01
    jobs = [(job.units, job.phase) for job in run.jobs()]
    assert jobs[:3] == [((THIRD,), Phase.DEEPEN)] * 3
    assert jobs[3:] == [((SECOND,), Phase.FILL)] * 3
    # The third unit costs every pair two seconds: its own and that of the new crops.
    tight = Run(30, limit=60.0, had=[(SWEEP, SECOND)] * 30)
    tight.learn(*UNITS)
    assert prefix_that_fits(view_of(tight)) == 2


def view_of(run: Run) -> Snapshot:
    return Snapshot(run.state, run.costs, run.budget, run.crew, 0.0)


def test_a_first_unit_that_never_runs_leaves_the_sweep_to_the_next_of_stage_1():
    run = Run(5)
    run.state.give_up(("matcher", SWEEP.name), DIED)
    # A unit of stage 2 would look at whole images, as long as no points exist.
    swept = [job.units[0] for job in run.jobs() if job.phase is Phase.SWEEP]
    assert swept == [THIRD] * 5


def test_no_forecast_is_printed_before_all_units_were_measured():
    run = Run(limit=1000.0, had=[(SWEEP,)] * 40)
    told = lambda: outlook(run.state, run.costs, run.budget, run.crew, 0.0)  # noqa: E731
    run.learn(SWEEP, THIRD)
    assert told() == ""
    run.learn(SECOND)
    assert told().startswith(
        "all units on all pairs would take 1m52s; 3 of 3 units can run in the remaining "
    )


def test_a_pair_with_unmeasured_units_needs_several_jobs_and_the_last_says_so():
    run = Run(2, limit=1000.0, had=[(SWEEP,)] * 2)
    run.learn(SWEEP)
    deepening = [(job.indices, job.units, job.is_last) for job in run.jobs()]
    # The first pair shows what each unit costs. The bar once counted it twice.
    assert deepening == [
        ((0,), (THIRD,), False),
        ((0,), (SECOND,), True),
        ((1,), (THIRD, SECOND), True),
    ]


def test_a_part_of_many_due_estimates_is_handed_out_and_nothing_forgets_the_others(monkeypatch):
    monkeypatch.setattr(schedule, "MAX_DUE", 3)
    run = Run(count=8, had=[UNITS] * 8)
    due = []
    while work := run.next_work().estimates:
        assert len(work) <= 3
        due += work
        run.state.begin_estimates(work)
    assert sorted(due) == list(range(8))


@pytest.mark.parametrize("reserve", [0, 100])
def test_a_unit_begins_only_if_it_ends_before_the_time_reserved_for_estimates_and_scenes(reserve):
    run = Run(3, limit=100.0, had=[(SWEEP,)] * 3)
    run.learn(*UNITS)
    # Three estimates of 5 s are more than the 10 s before the end.
    for _ in range(reserve):
        run.costs.observe("estimate", 5.0)
    now = run.budget.stop_units - 10.0
    assert (run.next(now) is None) == bool(reserve)


def test_units_that_do_not_fit_for_all_go_to_the_weakest_pairs_in_the_time_left():
    run = Run(60, limit=100.0)
    # The number of inliers is the pair's index, so the first pairs are the weakest.
    filled = []
    for job in run.jobs(inliers=lambda index: index):
        if job.phase is Phase.FILL:
            filled += job.indices
    assert filled == sorted(filled)
    assert filled[0] < 3
    assert not run.is_complete


def test_pairs_for_the_scenes_alone_take_a_tenth_of_the_time_left_at_most():
    run = Run(6, limit=100.0, extra=80)
    jobs = list(run.jobs())
    assert run.state.current[:6].all()
    assert {job.units for job in jobs if job.phase is Phase.CONNECT} == {(SWEEP,)}
    had = np.flatnonzero(run.state.current[6:].any(1)).tolist()
    assert had == list(range(len(had))), "the most useful first"
    assert 5 < len(had) < 10
    assert run.is_complete


def test_two_workers_fit_more_units_than_one():
    run = Run(40, limit=100.0)
    run.finish(MatchJob(Phase.SWEEP, (0,), UNITS, (1.0,) * 3, math.inf))
    fits = []
    for run.crew in (Crew(1), Crew(2)):
        fits.append(run.next_work().fit)
    assert fits[0] < fits[1] == 3


def test_a_first_scene_waits_for_the_units_that_fit_and_a_later_scene_for_all():
    run = Run(6, limit=1000.0, had=[(SWEEP,)] * 6)
    request = run.state.request
    run.state = State(replace(request, recipe=replace(THREE_UNITS, scene=SceneConfig())))
    for index in range(6):
        run.have(index, (SWEEP, SECOND))
        run.state.matches[index] = 50
    run.state.estimated[:] = run.state.has_own[:] = True
    run.learn(SWEEP, SECOND)
    # The third unit does not fit for all pairs; many measurements, so that the forecast is certain.
    for _ in range(1000):
        run.costs.observe(THIRD.name, 400.0)
    assert run.next_work().scenes == ("",)
    run.state.scenes.in_use[""] = None
    assert run.next_work().scenes == ()
    run.crew = replace(run.crew, can_match=False)
    assert run.next_work().scenes == ("",)


def test_only_a_scene_that_cannot_be_made_from_todays_results_is_lost():
    run = Run(6, limit=1000.0)
    state = State(replace(run.state.request, recipe=replace(THREE_UNITS, scene=SceneConfig())))
    died = Failure(Cause.DIED)
    state.give_up(("scene", "", "a former key"), died)
    assert scene_failures(state) == {}
    state.give_up(("scene", "", state.scene_inputs("")[1]), died)
    assert scene_failures(state) == {"": died}
    # The processes of scenes cannot be started any more, after this batch has its scene.
    state.tries.given_up.clear()
    state.scenes.stale.clear()
    state.give_up(("scenes",), Failure(Cause.NOT_STARTED))
    assert scene_failures(state) == {}
    state.scenes.stale.add("")
    assert scene_failures(state) == {"": Failure(Cause.NOT_STARTED)}


def test_a_first_scene_does_not_wait_for_a_job_that_hangs_until_the_end():
    run = Run(6, limit=1000.0)
    request = replace(run.state.request, recipe=replace(THREE_UNITS, scene=SceneConfig()))
    run.state = State(request)
    for index in range(5):
        run.have(index, UNITS)
        run.state.matches[index] = 50
    run.state.estimated[:] = run.state.has_own[:] = True
    run.learn(*UNITS)
    run.state.begin_matching([5])
    stop = view_of(run).stop
    assert run.next_work(stop - 1.0).scenes == ()
    assert run.next_work(stop).scenes == ("",)
    run.state.scenes.in_use[""] = None  # a later scene needs all points
    assert run.next_work(stop).scenes == ()


# The engine on a virtual clock


def test_more_time_never_means_fewer_units():
    units = []
    for limit in (40.0, 80.0, 120.0, 999.0):
        ran = simulate(Scenario(40, (1.0, 1.0, 1.0), 1, limit, misses=0))
        assert ran.late == ran.lost == 0
        units.append(units_of(ran))
    assert units == sorted(units)
    assert 0 < units[0] < 40 < units[1] < units[-1] == 120


def units_of(ran):
    """The number of results of units of all pairs."""
    return int((ran.report.tables.units["failure"] == "").sum())


def test_random_runs_are_never_late_never_lose_a_row_and_use_their_time():
    runs = [without_tables(simulate(random_scenario(seed, pairs=150))) for seed in range(12)]
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


ABLATIONS = {  # a scenario that each mechanism of the plan serves
    "reserve for scenes": Scenario(600, (1.0,), 1, 500.0, warm_up=1, batches=2, scene_seconds=0.05),
    "margin of scenes": Scenario(400, (1.0,), 1, 500.0, warm_up=1, batches=8, scene_seconds=0.18),
    "margin of units": Scenario(150, (1.0,) * 4, 1, 500.0, warm_up=1, spread=1.0, seed=4),
    "connect share": Scenario(100, (1.0,) * 3, 1, 300.0, warm_up=1, batches=2, pairs_per_image=6.0),
    "short jobs": Scenario(100, (1.0,) * 8, 2, 300.0, warm_up=1, spread=0.5, crashes=0.01, seed=4),
    "time limits": Scenario(150, (1.0, 1.0), 1, 400.0, warm_up=1, hangs=0.01, misses=0, seed=1),
    "second try": Scenario(100, (1.0,), 1, 600.0, warm_up=1, crashes=0.05),
    "end of tries": Scenario(100, (0.5, 1.0, 1.0), 1, 300.0, warm_up=1, never="m1"),
}


@pytest.mark.parametrize("mechanism", ABLATIONS)
def test_a_mechanism_that_is_off_costs_units_or_scenes(monkeypatch, mechanism):
    def gained() -> tuple[int, int]:
        ran = simulate(ABLATIONS[mechanism])
        # Scenes count before units: a scene improves all pairs of its batch.
        return -ran.missed, units_of(ran)

    whole = gained()
    switch_off(mechanism, monkeypatch.setattr)
    assert gained() < whole


def test_planning_a_job_does_not_take_much_longer_for_many_pairs():
    seconds_per_pair = []
    for count in (100, 1_000):
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
    ran = simulate(Scenario(900, (0.5, 1.0), 1, 7200.0, batches=9, scene_faults=0.4, seed=3))
    assert any(scene.seconds == math.inf for scene in ran.scenes)
    assert ran.late == ran.lost == ran.missed == 0
    assert any("the worker hung" in fault for fault in ran.report.faults)


@pytest.mark.parametrize("moment", [50, 450, 850])
def test_a_run_killed_at_any_moment_leaves_no_scene_out_of_date_when_it_resumes(moment):
    scenario = Scenario(300, (0.5, 1.0), 1, 3600.0, batches=3, pairs_per_image=1.0, misses=0)
    store = memory_store()
    simulate(scenario, store, until=moment)
    ran = simulate(scenario, store)
    assert ran.report.ending is Ending.COMPLETE
    assert ran.stale == set()
    assert units_of(ran) == 600


def test_the_simulator_counts_no_time_as_wasted_in_which_there_is_nothing_to_do():
    # The last pair costs each place its worker, and no other is needed while the scene is made.
    lost = Scenario(20, (1.0,), 2, 300.0, batches=1, scene_seconds=60.0, bad=(18, 19))
    ran = simulate(replace(lost, bad_fate=Cause.DIED))
    assert ran.work_left
    assert ran.utilisation > 0.95
    # A run that waits for a bad pair until its end has done all other work.
    waiting = simulate(Scenario(20, (1.0,), 2, 60.0, bad=(19,), bad_fate=Cause.TIMED_OUT))
    assert waiting.report.ending is Ending.TIME_IS_UP
    assert not waiting.work_left


def test_time_reserved_for_scenes_is_used_for_units_when_they_need_less():
    ran = simulate(Scenario(600, (0.1, 0.2, 0.3), 1, 280.0, warm_up=1, batches=1))
    assert ran.work_left
    assert ran.report.seconds > 275.0


def test_a_job_of_an_earlier_request_is_saved_before_the_next_request_begins():
    scenario = Scenario(10, (10.0,), 1, 1000.0, spread=0, misses=0, warm_up=0)
    clock = VirtualClock()
    nothing = Request((), scenario.recipe, scenario.keys)
    time = Budget(0.0, scenario.limit, clock)
    site = SimulatedSite(scenario, clock, time.stop_units)
    pairs = [Pair(str(n), "", str(n), "b") for n in range(10)]
    with Engine(site, memory_store(), time, interrupt=threading.Event(), progress=False) as engine:
        # 50 of 1,000 s: the fifth pair of 10 s each is under way at the end of the trial.
        engine.ask(replace(nothing, pairs=pairs), share=0.05)
        assert engine.state.has.sum() == 5
        engine.ask(replace(nothing, pairs=pairs[4:6]))
        report = engine.report()
    assert (report.ending, report.units_run) == (Ending.COMPLETE, 6), "five, and the sixth"


def test_scenes_that_never_begin_are_named_and_the_run_ends(monkeypatch):
    def never_ready(site):
        return SimulatedWorker(site, site.reconstruct, math.inf)

    monkeypatch.setattr(SimulatedSite, "scene_worker", never_ready)
    ran = simulate(Scenario(300, (0.5, 1.0), 1, 900.0, batches=3, misses=0))
    assert ran.late == 0
    assert explained(ran.report.faults, "scenes 0: the worker hung: no answer for ")
    assert all(scene.failure for scene in ran.report.scenes)


def test_a_lost_job_comes_back_as_single_units_and_a_unit_lost_twice_is_skipped_for_its_pair():
    lost = []

    class FailingSite(SimulatedSite):
        def match(self, warm, job):
            names = [unit.name for unit in job.units]
            if job.indices == (2,) and units[2].name in names:
                lost.append(names)
                return 1.0, DIED, 1.0
            return super().match(warm, job)

    scenario = Scenario(4, (1.0,) * 3, 1, math.inf, spread=0, misses=0)
    units = scenario.recipe.units
    engine, report = ran_at(FailingSite, scenario)
    # First with the pair's other unit; then alone, twice
    assert lost == [["1:m2@100", "2:m1@100"], ["1:m2@100"], ["1:m2@100"]]
    assert engine.state.tries.given_up == {("unit", 2, "1:m2@100"): DIED}
    told = "1:m2@100 is skipped on pair 2 (the worker died: signal SIGKILL)"
    assert explained(report.explanations, told)
    assert report.ending is Ending.WITH_FAILURES
    missing = np.argwhere(~engine.state.current)
    assert missing.tolist() == [[2, 2]]


def ran_at(site_class, scenario, store=None, publish=lambda _: None):
    clock = VirtualClock()
    time = Budget(0.0, scenario.limit, clock)
    pairs = [Pair(str(n), "", str(n), "b") for n in range(scenario.pairs)]
    site = site_class(scenario, clock, time.stop_units)
    store = store or memory_store()
    with Engine(site, store, time, interrupt=threading.Event(), progress=False) as engine:
        engine.ask(Request(pairs, scenario.recipe, scenario.keys, publish=publish))
        return engine, engine.report()


def test_a_unit_that_never_ran_is_skipped_on_all_pairs_after_two():
    scenario = Scenario(200, (1.0,) * 3, 1, math.inf, misses=0, never="m1")
    engine, report = ran_at(SimulatedSite, scenario)
    # On each pair it would cost two workers.
    assert engine.state.unusable.tolist() == [False, True, False]
    assert report.ending is Ending.WITH_FAILURES
    assert explained(report.explanations, "2:m1@100 is skipped on all pairs: it never ran")
    assert sum("lost" in fault for fault in report.faults) == 1, "the same text is told once"


def test_scenes_at_several_places_take_less_time_and_end_as_at_one():
    # Twelve scenes take longer than the matching, so they decide how long the run takes.
    settings = {"warm_up": 1, "batches": 12, "scene_seconds": 0.3, "misses": 0}
    scenario = Scenario(600, (0.1,), 1, math.inf, **settings)
    seconds = []
    written = []
    for places in (1, 4):
        ran = simulate(replace(scenario, scene_places=places))
        assert ran.missed == 0
        seconds.append(ran.report.seconds)
        written.append(matrices_of(ran.report.tables.pairs).tobytes())
    assert seconds[1] < 0.6 * seconds[0]
    assert written[0] == written[1]


def test_the_loop_reads_nothing_back_but_the_points_of_crops_and_estimates(monkeypatch):
    read = []
    is_looping = []
    loop = Engine._loop

    def noted(engine: Engine) -> None:
        is_looping.append(True)
        loop(engine)
        is_looping.clear()

    def rows(
        store: Store, layout: Layout, columns: str, part: slice, keys: Iterable[str] | None
    ) -> Iterable[tuple[str, object]]:
        asked = None if keys is None else list(keys)
        if is_looping and asked:
            read.append((layout.table, columns))
        return whole(store, layout, columns, part, asked)

    whole = Store._read
    monkeypatch.setattr(Engine, "_loop", noted)
    monkeypatch.setattr(Store, "_read", rows)
    ran = simulate(Scenario(40, (1.0, 1.0), 1, math.inf, misses=0, batches=4))
    assert len(ran.scenes) >= 4
    # Answers update the state; the store is for the next run.
    assert set(read) == {("points", "data")}
    # An estimator gets the points of a pair in its job: after the sweep, and with those of its crops.
    assert len(read) <= 40 + 2 * 40


def test_the_file_and_the_report_agree_on_an_image_that_is_replaced_during_a_run():
    by_scene = Choice(np.arange(1.0, 10.0).reshape(3, 3), Reason.SCENE)

    class FirstSite(SimulatedSite):
        def reconstruct(self, job):
            return 3.0, Solution((), (by_scene,) * len(job.pairs)), 0.0

    class LaterSite(SimulatedSite):
        """The first pair's image has another content, and no scene is made of it."""

        def match(self, warm, job):
            seconds, (outcome,), fault = super().match(warm, job)
            if job.indices == (0,):
                image0, image1 = outcome.images
                outcome = replace(outcome, images=(replace(image0, digest="another"), image1))
            return seconds, (outcome,), fault

        def reconstruct(self, job):
            return 3.0, DIED, 0.0

    scenario = Scenario(4, (1.0,), 1, math.inf, spread=0, misses=0, batches=1)
    store, written = memory_store(), []
    ran_at(FirstSite, scenario, store)
    another_unit = replace(scenario, costs=(1.0, 1.0))
    publish = lambda state: written.append(state.fundamentals)  # noqa: E731
    _, report = ran_at(LaterSite, another_unit, store, publish)
    assert sources(report) == ["pair", "scene", "scene", "scene"]
    np.testing.assert_array_equal(written[-1], matrices_of(report.tables.pairs))


def test_reading_how_a_run_ended_changes_nothing():
    scenario = Scenario(40, (1.0, 1.0), 1, 60.0, misses=0, batches=2)
    engine, report = ran_at(SimulatedSite, scenario)
    state = engine.state

    def contents():
        return set(state.scenes.stale), dict(state.tries.given_up), state.missing.tolist()

    before = contents()
    endings = {engine.ending for _ in range(3)}
    assert endings == {report.ending}
    assert contents() == before
