"""The planner's decisions, and the engine on a virtual clock."""

import math
from collections.abc import Iterator
from dataclasses import replace
from statistics import median

import numpy as np
import pytest
from mkpc_kaggle.engine.planner import Planner
from mkpc_kaggle.engine.upgrade import UpgradeConfig, is_weak
from rectified import SECOND, SWEEP, THREE_UNITS
from simulator import RESTART_SECONDS, Scenario, random_scenario, simulate, without_records

from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.costs import Timeouts
from mkpc_kaggle.engine.engine import Ending
from mkpc_kaggle.engine.jobs import Cause, Job, JobFailure, JobResult, Outcome, Phase
from mkpc_kaggle.engine.records import PairRecord, UnitRecord
from mkpc_kaggle.geometry.coordinates import Box
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Recipe


def planner(count: int = 40, recipe: Recipe = THREE_UNITS, workers: int = 1) -> Planner:
    records = [PairRecord.untouched(index) for index in range(count)]
    return Planner(range(count), recipe, records, Budget(0.0, math.inf, lambda: 0.0), workers)


def finished(job: Job, planner: Planner, inliers: int = 50) -> JobResult:
    """Every unit of a job took a second and found some inliers."""
    outcomes = []
    for index in job.indices:
        former = planner.records[index]
        new = former.lacking(job.units)
        units = former.units + tuple(UnitRecord(u.name, u.stage, 100, inliers, 0.0, 1.0, job.note) for u in new)
        results = tuple(UnitResult(unit, Matches.empty(), 0.0, 1.0) for unit in new)
        outcomes.append(Outcome(PairRecord(index, FALLBACK_FUNDAMENTAL, "", units), results))
    return JobResult(job, tuple(outcomes))


def jobs_of(planner: Planner) -> Iterator[Job]:
    """All jobs of a run in which each comes back before the next is planned."""
    while (job := planner.next(0.0)) is not None:
        yield job
        if planner.records[job.indices[0]].lacking(job.units):
            planner.take(finished(job, planner), 0.0)


def test_the_passes_follow_each_other_and_every_pair_has_every_unit() -> None:
    one = planner()
    phases = [job.phase for job in jobs_of(one)]
    assert phases == sorted(phases, key=list(Phase).index)
    assert one.complete
    assert all(not record.lacking(THREE_UNITS.units) for record in one.records)


def test_no_pair_is_in_two_jobs_at_a_time() -> None:
    one = planner(9, workers=4)
    first = one.next(0.0)
    out = [first]
    while (job := one.next(0.0)) is not None:
        out.append(job)
    indices = [index for job in out for index in job.indices]  # type: ignore[union-attr]
    assert len(indices) == len(set(indices))
    assert len(out) == 4, "every worker tries a unit whose cost is unknown, on one pair"


def test_a_unit_that_workers_always_fail_at_is_given_up_on_all_pairs() -> None:
    one = planner(200)
    lost = 0
    while (job := one.next(0.0)) is not None:
        if any(unit == SECOND for unit in job.units) and one.records[job.indices[0]].lacking([SECOND]):
            lost += 1
            one.lose(JobFailure(job, Cause.DIED), 0.0)
        else:
            one.take(finished(job, one), 0.0)
    assert lost < 40
    assert one.complete
    assert any(f"{SECOND.name} is given up: workers failed" in told.text for told in one.explanations)


def test_a_pair_at_which_the_device_always_fails_is_left_alone_by_this_run_only() -> None:
    one = planner(9)
    seen = []
    while (job := one.next(0.0)) is not None:
        if 3 in job.indices:
            seen.append((len(job.indices), job.shrink))
            assert one.lose(JobFailure(job, Cause.DEVICE, "CUDA error"), 0.0) == []
        else:
            one.take(finished(job, one), 0.0)
    assert seen == [(8, 1.0), (4, 1.0), (2, 1.0), (1, 1.0), (1, 1.0)]
    assert one.complete
    assert one.records[3].failure == "left alone: the device failed: CUDA error"
    assert one.records[3].units == ()
    assert all(not record.lacking(THREE_UNITS.units) for record in one.records if record.index != 3)


def test_a_job_that_no_worker_began_is_planned_again_as_it_was() -> None:
    one = planner(9)
    job = one.next(0.0)
    assert job is not None
    one.lose(JobFailure(job, Cause.NO_WORKER), 0.0)
    again = one.next(0.0)
    assert again is not None
    assert (again.indices, again.units, again.shrink) == (job.indices, job.units, 1.0)


def test_what_a_jobs_deadline_cut_off_is_planned_again() -> None:
    one = planner(17)
    one.budget = Budget(0.0, 1000.0, lambda: 0.0)
    for _ in range(2):  # by then the unit is measured
        one.take(finished(job := one.next(0.0), one), 0.0)  # type: ignore[arg-type]
    job = one.next(0.0)
    assert job is not None
    assert job.deadline < one.budget.stop
    whole = finished(job, one)
    nothing = Outcome(PairRecord.untouched(job.indices[-1]))
    one.take(replace(whole, outcomes=(*whole.outcomes[:-1], nothing)), job.deadline)
    again = one.next(job.deadline)
    assert again is not None
    assert (again.phase, again.indices) == (job.phase, job.indices[-1:])


def test_a_short_run_waits_less_for_a_silent_worker() -> None:
    timeouts = Timeouts()
    assert [timeouts.silence(limit) for limit in (20.0, 600.0, 32400.0)] == [5.0, 12.0, 60.0]


def test_silence_is_borne_longer_while_one_job_after_the_other_hangs() -> None:
    one = planner(40)
    for _ in range(2):  # by then the unit is measured
        one.take(finished(job := one.next(0.0), one), 0.0)  # type: ignore[arg-type]
    waits = []
    for _ in range(5):
        job = one.next(0.0)
        assert job is not None
        waits.append(job.timeout)
        one.lose(JobFailure(job, Cause.HUNG), 0.0)
    assert [wait / waits[0] for wait in waits] == [1, 2, 4, 8, 8]
    job = one.next(0.0)
    assert job is not None
    one.take(finished(job, one), 0.0)
    job = one.next(0.0)
    assert job is not None
    assert job.timeout == waits[0]


def test_pairs_are_weak_for_few_inliers_a_low_share_or_an_uncertain_region() -> None:
    def record(matches: int, inliers: int, reason: RegionReason = RegionReason.CROPPED) -> PairRecord:
        region = CriticalRegion(Box(0, 0, 9, 9), reason)
        unit = UnitRecord(SWEEP.name, 1, matches, inliers, 0.0, 0.0, "")
        return PairRecord(0, FALLBACK_FUNDAMENTAL, "", (unit,), (region, region))

    config = UpgradeConfig(below_inliers=50, below_share=0.2)
    assert is_weak(record(100, 49), config)
    assert not is_weak(record(100, 50), config)
    assert is_weak(record(1000, 199), config)
    assert is_weak(record(100, 60, RegionReason.NO_CLUSTER), config)
    assert not is_weak(record(100, 60, RegionReason.NO_CLUSTER), replace(config, uncertain=False))


def test_a_pairs_seconds_are_those_of_all_its_jobs() -> None:
    one = planner(1)
    jobs = 0
    while (job := one.next(0.0)) is not None:
        done = finished(job, one)
        jobs += 1
        timed = [
            replace(outcome, record=replace(outcome.record, cluster_seconds=1.0, estimate_seconds=2.0))
            for outcome in done.outcomes
        ]
        one.take(replace(done, outcomes=tuple(timed)), 0.0)
    assert jobs > 1
    assert (one.records[0].cluster_seconds, one.records[0].estimate_seconds) == (jobs, 2 * jobs)


def test_costs_that_change_are_planned_for_and_explained() -> None:
    ran = simulate(Scenario(400, (0.5, 1.0, 1.0), 0, 1, 1100.0, warm_up=1, misses=0, drift=10, turn=0.5))
    assert ran.late == 0
    assert ran.lost == 0
    assert ran.report.ending is Ending.TIME_IS_UP
    assert any("of 3 units fit" in one.text for one in ran.report.explanations)


@pytest.mark.parametrize(
    ("scenarios", "pairs", "middle", "low"),
    [
        (150, 300, 0.98, 0.8),
        pytest.param(1000, 10_000, 0.99, 0.95, marks=[pytest.mark.slow, pytest.mark.timeout(3 * 3600)]),
    ],
)
def test_random_runs_are_never_late_never_lose_a_row_and_use_their_time(
    scenarios: int, pairs: int, middle: float, low: float
) -> None:
    runs = [without_records(simulate(random_scenario(seed, pairs))) for seed in range(scenarios)]
    assert max(run.late for run in runs) == 0
    assert sum(run.lost for run in runs) == 0
    assert sum(run.missed for run in runs if run.scenes_fit) == 0
    used = [run.utilisation for run in runs if run.work_left]
    assert median(used) > middle
    assert np.percentile(used, 5) > low


def test_scenes_are_done_beside_matching_and_the_last_one_in_the_time_kept_for_it() -> None:
    costs = (0.5, 1.0, 1.0)
    ran = simulate(Scenario(600, costs, 0, 1, 1200.0, warm_up=1, batches=6, scene_seconds=0.3))
    assert ran.late == ran.lost == ran.missed == 0
    assert ran.work_left
    assert len({scene.batch for scene in ran.scenes}) == 6
    beside = [scene for scene in ran.scenes if scene.begun + scene.seconds < ran.last_job]
    assert len(beside) >= 5
    assert max(scene.seen for scene in ran.scenes) < 1200.0
    assert ran.utilisation > 0.95


def test_a_scene_that_hangs_is_ended_and_the_others_have_their_turn() -> None:
    ran = simulate(Scenario(900, (0.5, 1.0), 0, 1, 3600.0, batches=9, scene_faults=0.4, seed=3))
    hung = [scene for scene in ran.scenes if scene.seconds == float("inf")]
    assert hung
    assert ran.late == ran.lost == ran.missed == 0
    assert any("it hung" in fault for fault in ran.report.faults)


def test_undisturbed_runs_use_all_their_time() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        workers = int(rng.integers(1, 5))
        costs = tuple(rng.uniform(0.2, 2, 5).tolist())
        scenario = Scenario(600 * workers, costs, 1, workers, 2400.0, seed=seed)
        ran = simulate(replace(scenario, limit=0.8 * scenario.work + 60))
        assert ran.work_left
        assert ran.utilisation > 0.97, scenario


def test_planning_a_job_does_not_take_longer_for_many_pairs() -> None:
    ran = simulate(Scenario(20_000, (0.1, 0.5, 0.5), 1, 2, 20_000.0))
    assert ran.jobs > 2500
    assert ran.planning < 1e-3
    assert RESTART_SECONDS < ran.report.seconds < 20_000
