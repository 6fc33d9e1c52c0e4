import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mkpc_kaggle.engine.planner import units_that_fit

from mkpc_kaggle.engine.budget import Budget, format_duration, monotonic_of, parse_duration
from mkpc_kaggle.engine.costs import WINDOW, Costs, needs
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.recipe import Unit

UNITS = (Unit(1, "a", 100), Unit(2, "b", 100), Unit(1, "c", 100))


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("8h45m", 31500), ("90m", 5400), ("60s", 60), ("60", 60), ("1h", 3600), ("1h2m3s", 3723), ("2.5s", 2.5)],
)
def test_durations_are_read(text: str, seconds: float) -> None:
    assert parse_duration(text) == seconds


@pytest.mark.parametrize("text", ["", "h", "8 hours", "-5s", "1m1h", "0", "0s", "nan", "9:00"])
def test_what_is_no_duration_is_refused(text: str) -> None:
    with pytest.raises(UserError):
        parse_duration(text)


def test_durations_are_shown_short() -> None:
    assert [format_duration(s) for s in (4.24, 59.9, 61, 3599.9, 31500)] == [
        "4.2s",
        "59.9s",
        "1m01s",
        "1h00m",
        "8h45m",
    ]


def test_a_budget_stops_before_it_ends_and_ends_before_its_limit() -> None:
    for limit in (10.0, 60.0, 31500.0):
        budget = Budget(time.monotonic(), limit)
        assert budget.started < budget.stop < budget.end < budget.started + limit
        assert budget.left() <= limit


def test_a_spent_budget_has_nothing_left() -> None:
    assert Budget(time.monotonic() - 100, 60).left() == 0


def test_the_warm_up_counts_only_until_there_is_another_measurement() -> None:
    costs = Costs()
    assert not costs.known("a")
    costs.observe("a", 10.0, warm_up=True)
    assert not costs.known("a")
    assert costs.of("a") == 10.0
    costs.observe("a", 1.0)
    costs.observe("a", 9.0, warm_up=True)  # another worker's
    costs.observe("a", 2.0)
    assert costs.known("a")
    assert costs.of("a") == 1.5


def test_costs_follow_a_machine_that_slows_down() -> None:
    costs = Costs()
    for seconds in [1.0] * (WINDOW + 1) + [10.0] * WINDOW:
        costs.observe("a", seconds)
    assert costs.of("a") == 10.0


def test_a_supposed_cost_holds_only_for_a_unit_that_was_never_measured() -> None:
    costs = Costs()
    costs.observe("a", 1.0)
    costs.suppose("a", 99.0)
    costs.suppose("b", 99.0)
    assert costs.of("a") == 1.0
    assert costs.of("b") == 99.0


def known_costs(*seconds: float) -> Costs:
    costs = Costs()
    for unit, cost in zip(UNITS, seconds, strict=True):
        costs.observe(unit.name, cost)
    return costs


def test_the_longest_prefix_that_fits_is_chosen() -> None:
    costs = known_costs(1.0, 2.0, 4.0)
    lacking = {unit.name: 10 for unit in UNITS}
    assert [units_that_fit(needs(UNITS, lacking, costs), s)[0] for s in (13, 15, 43, 99)] == [0, 1, 2, 3]


def test_units_that_pairs_have_already_cost_nothing() -> None:
    costs = known_costs(1.0, 2.0, 4.0)
    lacking = {UNITS[0].name: 0, UNITS[1].name: 10, UNITS[2].name: 1}
    assert units_that_fit(needs(UNITS, lacking, costs), 34)[0] == 3


def test_waiting_counts_against_the_time_too() -> None:
    costs = known_costs(1.0, 2.0, 4.0)
    lacking = {unit.name: 10 for unit in UNITS}
    before = units_that_fit(needs(UNITS, lacking, costs), 45)[0]
    costs.observe_overhead(1.0)
    assert before == 2
    assert units_that_fit(needs(UNITS, lacking, costs), 45)[0] == 1


@given(
    st.lists(st.floats(0, 100), min_size=3, max_size=3),
    st.lists(st.integers(0, 1000), min_size=3, max_size=3),
    st.floats(0, 1e6),
    st.floats(1, 10),
)
def test_more_time_never_chooses_fewer_units(
    seconds: list[float], pairs: list[int], time_left: float, factor: float
) -> None:
    costs = known_costs(*seconds)
    lacking = {unit.name: count for unit, count in zip(UNITS, pairs, strict=True)}
    count = units_that_fit(needs(UNITS, lacking, costs), time_left)[0]
    assert count <= units_that_fit(needs(UNITS, lacking, costs), time_left * factor)[0]
    needed = sum(costs.of(unit.name) * lacking[unit.name] for unit in UNITS[:count])
    assert needed <= time_left


def test_forecasts_grow_surer_with_every_measurement() -> None:
    costs, margins = Costs(), []
    for _ in range(1000):
        costs.observe("a", 1.0)
        margins.append(costs.forecast("a") - 1)
    assert margins[0] == pytest.approx(0.4)
    assert margins[99] == pytest.approx(0.04)
    assert margins[-1] == pytest.approx(0.0127, abs=1e-3)
    assert margins == sorted(margins, reverse=True)


def test_a_stall_is_cut_and_cached_encodings_are_not() -> None:
    costs = Costs()
    for number in range(WINDOW + 1):
        costs.observe("cached", 5.0 if number % 4 == 0 else 1.0)
        costs.observe("stalled", 1000.0 if number == 20 else 1.0)
    assert costs.of("cached") == pytest.approx(2.0, rel=0.02)
    assert costs.most("cached") == 5.0
    assert costs.of("stalled") < 1.2
    assert costs.most("stalled") == 1.0


def test_forecasts_of_heavy_tailed_costs_are_not_too_low() -> None:
    rng = np.random.default_rng(0)
    shares = []
    for _ in range(200):
        costs = Costs()
        for seconds in np.exp(rng.normal(size=WINDOW + 1)):
            costs.observe("a", float(seconds))
        shares.append(costs.of("a") / np.exp(0.5))
    assert np.mean(shares) == pytest.approx(1, abs=0.04)


def test_a_limit_may_count_from_an_earlier_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    assert time.monotonic() - monotonic_of(time.time() - 90) == pytest.approx(90, abs=0.1)
    for nonsense in (time.time() + 3600, float("nan"), float("-inf")):
        with pytest.raises(UserError, match="no moment of the past"):
            monotonic_of(nonsense)
