"""Time limits of workers: one function, for each kind of job."""

from collections.abc import Callable
from typing import Any

import pytest

from mkpc_kaggle.engine.budget import (
    COST_OF_ESTIMATES,
    Budget,
    Costs,
    start_limit,
    time_limit,
)
from mkpc_kaggle.engine.request import EstimateJob, Job, MatchJob, MatchPlan, SceneJob
from mkpc_kaggle.recipe import Recipe, Unit

HOURS = 9 * 3600.0
UNIT = Unit(1, "sift", 640)
SOME: Any = None  # which no limit depends on


def matching(pairs: int) -> MatchJob:
    plan = MatchPlan(0, [], [0], [0.0], 100.0, [])
    return MatchJob((SOME,) * pairs, Recipe((UNIT,)), SOME, plan)


def scene(matches: int) -> SceneJob:
    return SceneJob((), SOME, SOME, (0, 0), "batch", "", "key", matches)


def estimates(pairs: int) -> EstimateJob:
    return EstimateJob((SOME,) * pairs, SOME, SOME)


def limit_of(job: Job, costs: Costs, hours: float = HOURS, since: float = 0.0) -> float:
    return time_limit(job, costs, Budget(0.0, hours, lambda: since), since)


def measured(name: str, seconds: float) -> Costs:
    costs = Costs()
    costs.observe(name, seconds)
    return costs


@pytest.mark.parametrize(
    ("name", "make"),
    [(UNIT.name, matching), (COST_OF_ESTIMATES, estimates)],
    ids=["units", "estimates"],
)
def test_a_measured_job_has_many_times_its_cost_and_more_pairs_have_more(
    name: str, make: Callable[[int], Job]
) -> None:
    one, ten = (limit_of(make(pairs), measured(name, 7.0)) for pairs in (1, 10))
    assert one > 20 * 7.0
    # The time that any worker may be silent is the same for both.
    assert ten - one == pytest.approx(9 * 30 * 7.0)


def test_a_warm_up_alone_is_no_measurement_and_is_allowed_again_after_one() -> None:
    costs = Costs()
    costs.observe(UNIT.name, 50.0, warm_up=True)
    assert limit_of(matching(1), costs) == limit_of(matching(1), Costs())
    costs.observe(UNIT.name, 1.0)
    assert (
        limit_of(matching(1), costs) == limit_of(matching(1), measured(UNIT.name, 1.0)) + 50
    )


@pytest.mark.parametrize("job", [matching(1), matching(64)], ids=["unit", "units"])
def test_a_job_of_unknown_cost_may_take_a_share_of_the_remaining_time(job: Job) -> None:
    early, late = (limit_of(job, Costs(), 3600.0, since) for since in (0.0, 1800.0))
    assert 0 < late < early < 3600 / 3
    # Without a limit, a hung worker still ends.
    assert limit_of(job, Costs(), float("inf")) < 2 * 3600


def test_a_first_estimate_that_hangs_takes_neither_an_hour_of_nine_nor_a_short_limit() -> (
    None
):
    assert limit_of(estimates(8), Costs()) < 600
    assert limit_of(estimates(8), Costs(), 60.0) < 30


def test_a_large_scene_is_not_killed_by_the_seconds_of_small_ones() -> None:
    costs = Costs()
    unmeasured = limit_of(scene(10**6), costs)
    costs.observe_scene(1000, 3.0)
    assert limit_of(scene(10**6), costs) >= 0.5 * unmeasured


def test_a_worker_without_matchers_must_start_within_a_share_of_a_short_limit() -> None:
    budget = Budget(0.0, 60.0, lambda: 0.0)
    assert start_limit(budget, 0.0, loads_matchers=False) < 20
    # The matchers of a slow disk are worth waiting for: without them nothing is matched.
    assert start_limit(budget, 0.0, loads_matchers=True) > 60
