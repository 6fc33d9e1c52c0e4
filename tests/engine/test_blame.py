"""Who is to blame for lost jobs: pairs, units or places, on a virtual clock.

Each row of the table runs at one, two and four places. Another place, where nothing is bad, takes over
once all are closed.
"""

from collections import Counter
from typing import Any

import pytest
from simulator import Ran, Scenario, simulate

from mkpc_kaggle.engine.jobs import Cause, Failure
from mkpc_kaggle.engine.plan.blame import Tries
from mkpc_kaggle.engine.workers.places import Place

PAIRS = 30
LIMIT = 3000.0  # much more than all the work takes
COSTS = (1.0, 1.0, 1.0)
CAUSES = [Cause.DEVICE, Cause.DIED, Cause.TIMED_OUT, Cause.OUT_OF_MEMORY]
DIED = Failure(Cause.DIED)

BAD = {
    "one": ((13,), Cause.DEVICE),
    "first three": ((0, 1, 2), Cause.DIED),
    "three in a row": ((20, 21, 22), Cause.DEVICE),
    "five in a row": ((10, 11, 12, 13, 14), Cause.OUT_OF_MEMORY),
    "spread": ((5, 28), Cause.TIMED_OUT),
}

at_places = pytest.mark.parametrize("places", [1, 2, 4])


def ran_at(places: int, **settings: Any) -> Ran:
    scenario = Scenario(PAIRS, COSTS, places, LIMIT, warm_up=1, fallback=True)
    ran = simulate(Scenario(**{**vars(scenario), **settings}))
    assert ran.report.ending.is_done
    return ran


def assert_given_up(ran: Ran, bad: tuple[int, ...]) -> None:
    """Assert that the bad pairs have no unit, all others have all, and nobody else is to blame."""
    units = [unit.name for unit in ran.scenario.recipe.units]
    assert set(ran.given_up) == {("unit", pair, unit) for pair in bad for unit in units}
    matched = Counter(ran.report.tables.units.query("failure == ''")["pair"])
    for index, pair in enumerate(ran.report.tables.pairs["pair"]):
        assert matched[pair] == (0 if index in bad else len(units)), index


@at_places
@pytest.mark.parametrize("minibatch", [1, 8])
@pytest.mark.parametrize("name", BAD)
def test_bad_pairs_are_given_up_and_close_no_place(places, minibatch, name):
    bad, cause = BAD[name]
    ran = ran_at(places, bad=bad, bad_fate=cause, minibatch=minibatch)
    assert (ran.closed, ran.on_fallback) == ((), 0)
    assert_given_up(ran, bad)


@at_places
@pytest.mark.parametrize("cause", CAUSES)
def test_a_pair_is_given_up_whatever_it_does(places, cause):
    assert_given_up(ran_at(places, bad=(5,), bad_fate=cause), (5,))


@at_places
@pytest.mark.parametrize("cause", CAUSES)
def test_a_bad_place_is_closed_and_its_jobs_are_done_elsewhere(places, cause):
    ran = ran_at(places, bad_places=1, bad_fate=cause)
    # Until a place has hung three times, the others have done all the work.
    if cause is not Cause.TIMED_OUT or places == 1:
        assert ran.closed == (f"place {places - 1}",)
    assert (ran.on_fallback > 0) == (places == 1)
    assert_given_up(ran, ())


@pytest.mark.parametrize(("places", "minibatch"), [(1, 1), (2, 1), (4, 1), (1, 8), (2, 8)])
def test_a_place_that_breaks_in_the_middle_is_closed(places, minibatch):
    ran = ran_at(places, bad_places=1, broken=20.0 / LIMIT, minibatch=minibatch)
    assert ran.closed == (f"place {places - 1}",)
    assert_given_up(ran, ())


@at_places
def test_the_last_place_takes_over_if_all_are_bad(places):
    ran = ran_at(places, bad_places=places)
    assert len(ran.closed) == places
    assert_given_up(ran, ())


@pytest.mark.parametrize("places", [2, 4])
@pytest.mark.parametrize("bad", [(0,), (0, 1, 2), (25, 26)])
def test_a_bad_place_and_bad_pairs_are_told_apart(places, bad):
    ran = ran_at(places, bad_places=1, bad=bad, bad_fate=Cause.DIED)
    assert ran.closed == (f"place {places - 1}",)
    assert ran.on_fallback == 0
    assert_given_up(ran, bad)


@at_places
@pytest.mark.parametrize("never", ["m0", "m1", "m2"])
def test_a_unit_that_fails_on_all_pairs_is_given_up_everywhere_after_a_few(
    monkeypatch, places, never
):
    lost = []
    lose = Place.lose

    def noted(place: Place, *arguments: Any) -> None:
        lost.append(place.name)
        lose(place, *arguments)

    monkeypatch.setattr(Place, "lose", noted)
    ran = ran_at(places, never=never)
    assert (ran.closed, ran.on_fallback) == ((), 0)
    everywhere = [item for item in ran.given_up if item[0] == "matcher"]
    assert [item[1].split("@")[0][2:] for item in everywhere] == [never]
    ran_units = Counter(ran.report.tables.units.query("failure == ''")["pair"])
    assert {ran_units[pair] for pair in ran.report.tables.pairs["pair"]} == {2}
    assert len(lost) <= 6 * places


def test_losses_of_a_closed_place_are_forgiven():
    item = ("unit", 3, "1:sift@100")
    other = ("unit", 4, "1:sift@100")
    tries = Tries()
    assert not tries.lose([item], DIED)  # on a place that is closed later
    assert tries.lose([item], DIED)  # on another
    assert tries.forgive([frozenset([item])]) == [item]
    assert item not in tries.given_up
    # The other place's loss still counts.
    assert tries.lose([item], DIED)
    # A job of several items says nothing about each.
    tries.lose([item, other], DIED)
    assert tries.forgive([frozenset([item, other])]) == []
    assert item in tries.given_up
    assert other not in tries.alone


def test_a_unit_that_was_answered_has_its_tries_again():
    item = ("unit", 3, "2:sift@100")
    tries = Tries()
    tries.lose([item], DIED)
    tries.succeed(item)
    # Better crops let it run again.
    assert not tries.lose([item], DIED)


def test_another_device_takes_over_the_failures_of_scenes_and_no_others():
    tries = Tries()
    items = [("unit", 1, "1:sift@640"), ("pair", 2), ("scene", "a", "key"), ("scenes",)]
    for item in items:
        tries.given_up[item] = DIED
    assert list(tries.of_scenes().given_up) == items[2:]
