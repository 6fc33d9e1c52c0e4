import math
import time

import numpy as np
import pytest

from mkpc_kaggle.cli.options import monotonic_of
from mkpc_kaggle.engine.budget import (
    SCENE_MARGIN,
    SCENE_START_S,
    WINDOW,
    Budget,
    Costs,
)
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.progress import parse_duration


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("8h45m", 31500),
        ("90m", 5400),
        ("60s", 60),
        ("60", 60),
        ("1h", 3600),
        ("1h2m3s", 3723),
        ("2.5s", 2.5),
    ],
)
def test_durations_are_read(text: str, seconds: float) -> None:
    assert parse_duration(text) == seconds


def test_the_four_moments_of_a_budget_follow_each_other() -> None:
    for limit in (10.0, 60.0, 31500.0):
        budget = Budget(0.0, limit, lambda: 0.0)
        moments = [
            0.0,
            budget.stop_units,
            budget.stop_waiting,
            budget.final_write,
            budget.limit,
        ]
        # No two are equal: each moment leaves time for the work of the next.
        assert moments == sorted(set(moments))
        assert budget.left() == budget.stop_units
    too_late = Budget(0.0, 60, lambda: 100.0)
    assert too_late.left() == 0


def test_a_single_slow_write_is_forgotten_and_slow_writes_are_not() -> None:
    budget = Budget(0.0, 32400.0, lambda: 0.0)
    assert budget.writing == 0
    # A disk may stall once; to reserve 200 s for each later version would waste the time.
    for seconds in (2.0, 200.0, 2.0):
        budget.writes.append(seconds)
    assert budget.writing == 3.0
    # A disk that stays slow counts.
    for _ in range(3):
        budget.writes.append(40.0)
    assert budget.writing == 60.0
    short = Budget(0.0, 100.0, lambda: 0.0)
    short.writes.append(90.0)
    assert short.writing == 5.0, "a small share of the limit at most"
    assert short.stop_units > 50


def test_the_warm_up_counts_only_until_there_is_another_measurement() -> None:
    costs = Costs()
    assert not costs.is_known("a")
    # The first run of a network compiles and allocates: it may take ten times as long.
    costs.observe("a", 10.0, warm_up=True)
    assert not costs.is_known("a")
    assert costs.mean("a") == 10.0
    costs.observe("a", 1.0)
    # Another worker warms up later; its first run says nothing new.
    costs.observe("a", 9.0, warm_up=True)
    for seconds in (2.0, 6.0):
        costs.observe("a", seconds)
    assert costs.is_known("a")
    assert costs.mean("a") == 3.0 < costs.forecast("a")


def test_costs_follow_a_machine_that_slows_down() -> None:
    costs = Costs()
    # The mean of all measurements would follow too late.
    for seconds in [1.0] * (WINDOW + 1) + [10.0] * WINDOW:
        costs.observe("a", seconds)
    assert costs.mean("a") == 10.0


def test_a_forecast_of_scenes_has_their_starts_and_a_margin() -> None:
    costs = Costs()
    costs.observe_scene(1000, SCENE_START_S + 10.0)
    seconds = float(costs.scenes(np.array([2000]))[0])
    assert seconds == pytest.approx(SCENE_START_S + SCENE_MARGIN * 20.0)


def test_a_limit_may_count_from_an_earlier_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "time", lambda: 1000.0)
    monkeypatch.setattr(time, "monotonic", lambda: 70.0)
    assert monotonic_of(910.0) == -20.0
    assert monotonic_of(1000.5) == 70.0, "the wall clock was set back by a hair"
    for nonsense in (1061.0, math.nan, -math.inf):
        with pytest.raises(UserError, match="not a moment of the past"):
            monotonic_of(nonsense)
