"""The plan's decisions, and the engine on a virtual clock."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from statistics import median

import numpy as np
import pytest
from rectified import SECOND, SWEEP, THIRD, THREE_UNITS
from simulator import MemoryJournal, Scenario, SimulatedScene, random_scenario, simulate, without_records

from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.engine import Ending
from mkpc_kaggle.engine.jobs import Cause, Failure, MatchJob, MatchResult, Outcome, Phase
from mkpc_kaggle.engine.plan import HANG_FACTOR, JOB_PAIRS, Plan, job_size
from mkpc_kaggle.engine.records import PairRecord, UnitRecord
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Unit

DIED = Failure(Cause.DIED, "signal SIGKILL")


def plan_of(
    count: int = 40,
    limit: float = math.inf,
    extra: int = 0,
    had: Sequence[Sequence[Unit]] = (),
    outdated: Iterable[int] = (),
) -> Plan:
    """``had``: the units that the first pairs have had."""
    records = [PairRecord.untouched(index) for index in range(count + extra)]
    for index, units in enumerate(had):
        found = tuple(UnitRecord(unit.name, unit.stage, 100, 50, 0.0, 1.0, "") for unit in units)
        records[index] = PairRecord(index, FALLBACK_FUNDAMENTAL, "", found)
    budget = Budget(0.0, limit, lambda: 0.0)
    explanations: list[str] = []
    plan = Plan(range(count + extra), count, THREE_UNITS, records, budget, explanations.append, outdated=outdated)
    plan.explanations = explanations
    return plan


def finished(job: MatchJob, plan: Plan, inliers: Callable[[int], int] = lambda _: 50) -> MatchResult:
    """Every unit of a job took a second and found some inliers."""
    outcomes = []
    for index in job.indices:
        former = plan.records[index]
        new = former.lacking(job.units)
        found = (UnitRecord(unit.name, unit.stage, 100, inliers(index), 0.0, 1.0, "") for unit in new)
        results = tuple(UnitResult(unit, Matches.empty(), 0.0, 1.0) for unit in new)
        outcomes.append(Outcome(PairRecord(index, FALLBACK_FUNDAMENTAL, "", (*former.units, *found)), results))
    return MatchResult(tuple(outcomes))


def jobs_of(
    plan: Plan,
    fails: Callable[[MatchJob], Failure | None] = lambda _: None,
    inliers: Callable[[int], int] = lambda _: 50,
    *,
    cautious: bool = True,
) -> Iterator[MatchJob]:
    """All jobs of a place, each of which comes back, or is lost, before the next is planned."""
    now, failure = 0.0, None
    while (job := plan.next(now, "here", cautious=cautious and failure is not None)) is not None:
        yield job
        result, failure = finished(job, plan, inliers), fails(job)
        now += result.unit_seconds
        if failure is None:
            plan.on_result(job, result, result.unit_seconds)
        else:
            plan.on_failure(job, failure, "here")


def learnt(plan: Plan, unit: Unit) -> Plan:
    """What a unit costs is known, a second."""
    plan.costs.observe(unit.name, 1.0)
    return plan


def explained(plan: Plan, text: str) -> bool:
    return explained_in(plan.explanations, text)


def explained_in(explanations: Iterable[object], text: str) -> bool:
    return any(text in str(explanation) for explanation in explanations)


def test_the_phases_follow_each_other_and_every_pair_has_every_unit():
    plan = plan_of(extra=3)
    phases = [job.phase for job in jobs_of(plan)]
    assert phases == sorted(phases, key=list(Phase).index)
    assert plan.is_complete
    assert all(not record.lacking(THREE_UNITS.units) for record in plan.records[:40])
    assert [len(record.units) for record in plan.records[40:]] == [1, 1, 1]


def test_no_pair_is_in_two_jobs_at_a_time():
    plan = plan_of(9)
    jobs = []
    while (job := plan.next(0.0)) is not None:
        jobs.append(job)
    indices = [index for job in jobs for index in job.indices]
    assert sorted(indices) == list(range(9))
    assert {len(job.indices) for job in jobs} == {1}, "the cost of the unit is unknown"


@pytest.mark.parametrize(
    ("cautious", "pairs", "units"),
    [
        (False, [8, 4, 2, 1, 1, 1, 1], [(THIRD, SECOND), (THIRD,), (THIRD,), (SECOND,)]),
        (True, [8, 1, 1, 1], [(THIRD,), (THIRD,), (SECOND,)]),
    ],
)
def test_a_lost_job_is_tried_by_fewer_pairs_then_by_units_and_given_up_for_its_pair(cautious, pairs, units):
    plan = plan_of(9)
    seen = []

    def fails(job: MatchJob) -> Failure | None:
        seen.append((job.indices, job.units))
        return DIED if job.phase is Phase.DEEPEN and 1 in job.indices and THIRD in job.units else None

    list(jobs_of(plan, fails, cautious=cautious))
    deepened = [(indices, units) for indices, units in seen if SWEEP not in units and 1 in indices]
    assert [len(indices) for indices, _ in deepened] == pairs
    assert [tried for _, tried in deepened[-len(units) :]] == units
    failures = {
        (index, unit.unit): unit.failure
        for index in range(9)
        for unit in plan.records[index].units
        if unit.failure
    }
    assert failures == {(1, THIRD.name): "given up: the worker died: signal SIGKILL"}
    assert plan.records[1].failure == "", "it keeps the F that it has"
    assert plan.is_complete


def test_a_unit_that_never_ran_is_given_up_on_all_pairs_after_some():
    plan, lost = plan_of(200), []

    def fails(job: MatchJob) -> Failure | None:
        if SECOND not in job.units:
            return None
        lost.append(job)
        return DIED

    list(jobs_of(plan, fails))
    assert len(lost) <= JOB_PAIRS
    assert plan.unusable == {SECOND.name}
    assert plan.is_complete
    assert explained(plan, f"{SECOND.name} is given up on all pairs: it never ran")


def test_a_lost_job_is_tried_again_in_another_place_where_there_is_one():
    plan = learnt(plan_of(1), SWEEP)
    plan.workers = 2
    job = plan.next(0.0, "first")
    plan.on_failure(job, DIED, "first")
    assert plan.next(1.0, "first") is None
    again = plan.next(1.0, "second")
    assert again.indices == job.indices


def test_a_place_that_lost_a_worker_tries_one_pair_and_one_unit_that_was_not_lost():
    plan = plan_of(40)
    deepening = next(job for job in jobs_of(plan) if job.phase is Phase.DEEPEN and len(job.indices) == 8)
    plan.on_failure(deepening, DIED, "here")
    careful = plan.next(0.0, "here", cautious=True)
    assert (len(careful.indices), len(careful.units)) == (1, 1)
    assert not set(careful.indices) & set(deepening.indices)


def test_what_a_jobs_own_deadline_cut_off_is_planned_again():
    plan = learnt(plan_of(17, limit=1000.0), SWEEP)
    plan.next(0.0)  # the first pair, alone
    job = plan.next(0.0)
    whole = finished(job, plan)
    nothing = Outcome(PairRecord.untouched(job.indices[-1]))
    plan.on_result(job, MatchResult((*whole.outcomes[:-1], nothing)), 7.0)
    again = plan.next(7.0)
    assert (again.phase, again.indices) == (job.phase, job.indices[-1:])


THIRD_ALONE = UnitRecord(THIRD.name, THIRD.stage, 9, 9, 0.0, 1.0, "")


@pytest.mark.parametrize(
    ("record", "results"),
    [
        (PairRecord.untouched(0, "the file is empty"), ()),
        (PairRecord(0, FALLBACK_FUNDAMENTAL, "", (THIRD_ALONE,)), (UnitResult(THIRD, Matches.empty(), 0.0, 1.0),)),
    ],
)
def test_a_pair_whose_image_or_earlier_results_cannot_be_read_any_more_keeps_the_f_that_it_has(record, results):
    plan = plan_of(1)
    deepening = next(job for job in jobs_of(plan) if job.phase is Phase.DEEPEN)
    former = plan.records[0]
    assert plan.on_result(deepening, MatchResult((Outcome(record, results),)), 1.0) == []
    assert explained(plan, "pair 0 keeps the F it has: the file is empty") is not bool(results)
    assert plan.records[0] is former
    assert plan.next(1.0) is None


def test_progress_counts_the_pairs_that_have_an_f():
    plan = plan_of(12)
    job = plan.next(0.0)
    not_begun = MatchResult(tuple(Outcome(PairRecord.untouched(index)) for index in job.indices))
    plan.on_result(job, not_begun, 1.0)
    assert plan.progress == (Phase.SWEEP, 0, 12)


@pytest.mark.parametrize("limit", [20.0, 600.0, 32400.0])
def test_a_worker_hangs_after_many_times_what_its_units_take_and_sooner_in_a_short_run(limit):
    job = learnt(plan_of(limit=limit), SWEEP).next(0.0)
    assert job.seconds > 1.0
    assert job.time_limit < max(0.05 * limit + 20, 20)
    assert limit < 32400.0 or job.time_limit == job.seconds + HANG_FACTOR


def test_where_no_unit_ends_in_time_there_is_no_job_until_scenes_need_less():
    plan = plan_of(3, limit=100.0)
    for unit in THREE_UNITS.units:
        learnt(plan, unit)
    plan.reserve = 10.0
    now = plan.stop - 0.5
    assert plan.next(now) is None
    plan.reserve = 0.0
    assert plan.next(now).units == (SWEEP,)


def test_a_unit_that_does_not_end_in_time_is_kept_for_later_where_others_still_fit():
    plan = plan_of(1, limit=100.0, had=[(SWEEP, SECOND)])
    learnt(plan, SECOND)
    plan.costs.observe(THIRD.name, 20.0)
    plan.reserve = 15.0
    now = plan.stop - 10.0
    assert plan.next(now) is None
    plan.reserve = 0.0
    assert plan.next(now).units == (THIRD,)


@pytest.mark.parametrize(
    ("pairs", "prices", "seconds", "size"),
    [
        (8, [1.0, 1.0], 100.0, (8, 2)),
        (8, [1.0, 1.0], 6.0, (3, 2)),
        (8, [1.0, 1.0], 1.5, (1, 1)),
        (8, [1.0, None, 1.0], 100.0, (1, 2)),
        (8, [None, 1.0], 100.0, (1, 1)),
        (8, [5.0, None], 1.0, (1, 1)),
        (8, [], 100.0, (8, 0)),
    ],
)
def test_a_job_takes_a_share_of_the_time_left_and_explores_one_unit_on_one_pair(pairs, prices, seconds, size):
    assert job_size(pairs, prices, 0.0, seconds) == size


def test_a_job_has_only_units_that_its_own_pairs_lack():
    plan = plan_of(3, had=[(SWEEP,), (SWEEP, THIRD), (SWEEP,)])
    jobs = [plan.next(0.0, cautious=True) for _ in range(3)]
    assert [job.units for job in jobs] == [(THIRD,), (SECOND,), (THIRD,)]
    assert plan.on_failure(jobs[1], DIED, "here") == []


def test_units_that_do_not_fit_for_all_go_to_the_weakest_pairs_in_the_time_left():
    plan = plan_of(60, limit=100.0)
    jobs = list(jobs_of(plan, inliers=lambda index: index))
    filled = [index for job in jobs if job.phase is Phase.FILL for index in job.indices]
    assert explained(plan, "1 of 3 units fit")
    assert explained(plan, "pairs that lack units, the weakest first"), plan.explanations
    assert filled
    assert filled == sorted(filled)
    assert filled[0] < 2 + JOB_PAIRS
    assert not plan.is_complete


def test_a_unit_is_not_left_out_for_a_single_slow_pair():
    plan = learnt(plan_of(60, limit=1000.0), SWEEP)
    plan.costs.observe(SECOND.name, 60.0)
    deepened = {
        i for job in jobs_of(plan) if job.phase is Phase.DEEPEN and SECOND in job.units for i in job.indices
    }
    assert deepened == set(range(60))
    assert not explained(plan, "of 3 units fit"), plan.explanations


def test_pairs_that_are_at_work_when_the_filling_begins_are_filled_too():
    ran = simulate(Scenario(300, (0.5, 1.0, 1.0), 2, 500, drift=0.05, turn=0.6))
    assert explained_in(ran.report.explanations, "pairs that lack units, the weakest first")
    assert ran.report.ending is Ending.COMPLETE


def test_pairs_for_the_scenes_alone_take_a_tenth_of_the_time_left_at_most():
    plan = plan_of(6, limit=100.0, extra=80)
    jobs = list(jobs_of(plan))
    assert all(not record.lacking(THREE_UNITS.units) for record in plan.records[:6])
    extra = [job for job in jobs if job.phase is Phase.CONNECT]
    assert {job.units for job in extra} == {(SWEEP,)}
    had = [record.index for record in plan.records[6:] if record.units]
    assert had == list(range(6, 6 + len(had))), "the most wanted"
    assert 5 < len(had) < 10
    assert plan.is_complete


def test_other_devices_try_what_was_given_up_and_pairs_keep_what_they_have():
    plan = plan_of(4)
    list(jobs_of(plan, lambda job: DIED if SECOND in job.units else None))
    given_up = [record.index for record in plan.records if not record.lacking([SECOND])]
    assert plan.unusable == {SECOND.name}
    assert [changed.record.index for changed in plan.restart()] == given_up
    assert all(units == (SECOND,) for units in (job.units for job in jobs_of(plan)))
    assert plan.is_complete
    assert not any(unit.failure for record in plan.records for unit in record.units)


def test_a_pairs_seconds_are_those_of_all_its_jobs():
    plan, jobs = plan_of(1), 0
    while (job := plan.next(0.0)) is not None:
        (outcome,) = finished(job, plan).outcomes
        timed = replace(outcome.record, cluster_seconds=1.0, estimate_seconds=2.0)
        plan.on_result(job, MatchResult((replace(outcome, record=timed),)), 1.0)
        jobs += 1
    assert jobs > 1
    assert (plan.records[0].cluster_seconds, plan.records[0].estimate_seconds) == (jobs, 2 * jobs)


# The engine on a virtual clock


def test_more_time_never_means_fewer_units():
    runs = [simulate(Scenario(40, (1.0, 1.0, 1.0), 1, limit, misses=0)) for limit in (40.0, 80.0, 120.0, 999.0)]
    units = [sum(len(record.units) for record in ran.report.records) for ran in runs]
    assert units == sorted(units)
    assert 0 < units[0] < 40 < units[1] < units[-1] == 120
    assert all(ran.late == ran.lost == 0 for ran in runs)


def test_random_runs_are_never_late_never_lose_a_row_and_use_their_time():
    runs = [without_records(simulate(random_scenario(seed, pairs=300))) for seed in range(60)]
    assert max(run.late for run in runs) == 0
    assert sum(run.lost for run in runs) == 0
    fit = [run for run in runs if run.scenes_fit]
    assert sum(run.missed for run in fit) <= 0.02 * sum(run.scenario.batches for run in fit)
    used = [run.utilisation for run in runs if run.work_left]
    assert median(used) > 0.98
    assert np.percentile(used, 5) > 0.8


def test_undisturbed_runs_use_all_their_time():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        workers = int(rng.integers(1, 5))
        scenario = Scenario(600 * workers, tuple(rng.uniform(0.2, 2, 5).tolist()), workers, 2400.0, seed=seed)
        ran = simulate(replace(scenario, limit=0.8 * scenario.work + 60))
        assert ran.work_left
        assert ran.utilisation > 0.97, scenario


def test_planning_a_job_does_not_take_longer_for_many_pairs():
    seconds_per_pair = []
    for count in (500, 10_000):
        start = time.thread_time()  # whatever else the machine does
        simulate(Scenario(count, (0.1, 0.5, 0.5), 2, count))
        seconds_per_pair.append((time.thread_time() - start) / count)
    few, many = seconds_per_pair
    assert many < 5 * few


def test_scenes_are_done_beside_matching_and_the_last_in_the_time_kept_for_it():
    ran = simulate(Scenario(600, (0.5, 1.0, 1.0), 1, 1200.0, warm_up=1, batches=6, scene_seconds=0.3))
    assert ran.late == ran.lost == ran.missed == 0
    assert ran.work_left
    assert len({scene.batch for scene in ran.scenes}) == 6
    assert sum(scene.begun + scene.seconds < ran.last_job for scene in ran.scenes) >= 5
    assert ran.utilisation > 0.95


def test_a_scene_that_hangs_is_ended_and_the_others_have_their_turn():
    ran = simulate(Scenario(900, (0.5, 1.0), 1, 3600.0, batches=9, scene_faults=0.4, seed=3))
    assert any(scene.seconds == math.inf for scene in ran.scenes)
    assert ran.late == ran.lost == ran.missed == 0
    assert any("the worker hung" in fault for fault in ran.report.faults)


@pytest.mark.parametrize("moment", range(50, 1050, 100))
def test_a_run_killed_at_any_moment_leaves_no_scene_out_of_date_when_it_goes_on(moment):
    scenario = Scenario(300, (0.5, 1.0), 1, 3600.0, batches=3, pairs_per_image=1.0, misses=0)
    journal = MemoryJournal()
    simulate(scenario, journal, until=moment)
    ran = simulate(scenario, journal)
    assert ran.report.ending is Ending.COMPLETE
    assert {scene.batch: scene.unit_results for scene in ran.report.scenes} == ran.scene_units


def test_time_kept_for_scenes_is_used_for_units_when_they_need_less():
    ran = simulate(Scenario(600, (0.1, 0.2, 0.3), 1, 280.0, warm_up=1, batches=1))
    assert ran.work_left
    assert ran.report.seconds > 279.0


def test_a_scene_that_never_begins_is_named_and_the_others_have_their_turn(monkeypatch):
    start = SimulatedScene.start

    def stopped(scene: SimulatedScene) -> None:
        if len(scene._site.scenes) > 2:  # both tries of the first
            start(scene)

    monkeypatch.setattr(SimulatedScene, "start", stopped)
    ran = simulate(Scenario(300, (0.5, 1.0), 1, 600.0, batches=3, misses=0))
    assert ran.late == 0
    failures = {scene.batch: scene.failure for scene in ran.report.scenes}
    assert failures.pop("000").startswith("the worker hung: no answer for ")
    assert len(failures) == 2
    assert not any("hung" in failure for failure in failures.values())


def done_scenario(**changes):
    return Scenario(200, (0.5, 1.0), 2, 3600.0, batches=4, pairs_per_image=1.5, **changes)


def units_of(ran):
    return [record.units for record in ran.report.records]


@pytest.mark.parametrize("faults", [0.0, 0.2])
def test_where_the_estimation_alone_has_changed_no_unit_runs_and_every_f_and_scene_is_made_anew(faults):
    journal = MemoryJournal()
    first = simulate(done_scenario(), journal)
    assert first.report.ending == Ending.COMPLETE and first.report.estimated_anew == 0
    anew = simulate(done_scenario(threshold=1.0, job_faults=faults), journal)
    assert anew.report.ending == Ending.COMPLETE and anew.late == 0
    assert anew.report.units_run == 0 and units_of(anew) == units_of(first)
    assert {record.estimation for record in anew.report.records} != {r.estimation for r in first.report.records}
    assert len(anew.scenes) == len(first.scenes) == 4
    assert simulate(done_scenario(threshold=1.0), journal).report.estimated_anew == 0


def test_an_interrupted_estimation_goes_on_where_it_was_and_units_that_are_lacking_come_after_it():
    journal = MemoryJournal()
    first = simulate(done_scenario(), journal, until=250.0)
    assert first.report.ending == Ending.INTERRUPTED
    had = sum(len(units) for units in units_of(first))
    stopped = simulate(done_scenario(threshold=1.0), journal, until=9.0)
    assert stopped.report.units_run == 0 < stopped.report.estimated_anew < 200
    last = simulate(done_scenario(threshold=1.0), journal)
    assert last.report.ending == Ending.COMPLETE
    assert sum(len(units) for units in units_of(last)) == 400 > had
    swept = sum(bool(units) for units in units_of(first))
    assert stopped.report.estimated_anew + last.report.estimated_anew >= swept


def test_an_estimate_that_kills_its_worker_twice_is_given_up_and_the_pair_keeps_its_f():
    plan = plan_of(9, had=[THREE_UNITS.units] * 9, outdated=range(9))
    jobs = list(jobs_of(plan, lambda job: DIED if 4 in job.indices else None))
    assert {job.phase for job in jobs} == {Phase.ESTIMATE} and {job.units for job in jobs} == {()}
    assert len([job for job in jobs if job.indices == (4,)]) == 2
    assert (plan.estimated_anew, plan.is_complete) == (8, True)
    assert explained(plan, "pair 4 keeps the F it has: the worker died")


def test_units_wait_until_all_estimates_are_there():
    plan = plan_of(9, had=[[SWEEP]] * 5, outdated=range(5))
    first = plan.next(0.0, "one")
    assert first is not None and (first.phase, first.units, len(first.indices)) == (Phase.ESTIMATE, (), 1)
    assert {job.phase for job in jobs_of(plan)} == {Phase.ESTIMATE}, "scenes need F of all pairs"
    plan.on_result(first, finished(first, plan), 0.1)
    assert next(jobs_of(plan)).phase is Phase.SWEEP
