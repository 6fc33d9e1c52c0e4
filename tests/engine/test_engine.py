"""The engine with a matcher whose answers are known, in threads of this process."""

import math
import threading
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from rectified import (
    SECOND,
    SWEEP,
    THIRD,
    THREE_UNITS,
    RectifiedMatcher,
    matrices,
    run,
    write_pairs,
)

from mkpc_kaggle.engine.frames import Results
from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.signals import Interrupt


def units(report: Results) -> list[list[str]]:
    """The names of the units of each pair."""
    rows = dict(list(report.units.groupby("pair")))
    return [rows[pair]["unit"].tolist() for pair in report.pairs["pair"]]


def after_calls(count: int, act: Callable[[], None]) -> Callable[[int], int]:
    """Answers of a matcher that does something at the call of that number."""
    calls = iter(range(1, 10_000))

    def matches(_: int) -> int:
        if next(calls) == count:
            act()
        return 150

    return matches


def test_a_run_without_a_limit_gives_every_pair_every_unit(tmp_path):
    report = run(
        write_pairs(tmp_path, 11), THREE_UNITS, RectifiedMatcher(), tmp_path / "work"
    )
    assert report.ending is Ending.COMPLETE
    assert units(report) == [[SWEEP.name, SECOND.name, THIRD.name]] * 11
    pairs = report.pairs
    assert (pairs["failure"] == "").all()
    # Stage 2 sees the critical region only, so a few points at its border are lost.
    assert pairs["matches"].between(351, 450).all()
    assert (pairs["inliers"] == pairs["matches"]).all()
    for own in pairs["own"]:
        F = np.reshape(own, (3, 3))
        np.testing.assert_allclose(
            np.abs(F[1:, 1:]), [[0, 0.5**0.5], [0.5**0.5, 0]], atol=2e-3
        )
    assert all(match.regions for match in report.matches(*pairs["pair"]))


def test_every_published_version_is_complete_and_the_first_comes_before_any_work(tmp_path):
    matcher = RectifiedMatcher()
    published = []

    def publish(state: State) -> None:
        published.append((state.written[1], len(matcher.calls)))

    run(write_pairs(tmp_path, 5), THREE_UNITS, matcher, tmp_path / "work", publish=publish)
    assert published[0][1] == 0
    assert len(published) >= 2
    for version, _ in published:
        assert len(version) == 5
        assert all(np.isfinite(F).all() and F.any() for F in version)


def test_an_interrupted_run_resumes_and_ends_with_the_same_bytes(tmp_path):
    pairs = write_pairs(tmp_path, 20)
    interrupt = Interrupt()
    undisturbed = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "undisturbed")
    # Call 25 of 60 is a few jobs after the sweep of the 20 pairs.
    first = RectifiedMatcher(matches=after_calls(25, interrupt.set))
    cut = run(pairs, THREE_UNITS, first, tmp_path / "work", interrupt=interrupt)
    assert cut.ending is Ending.INTERRUPTED
    assert cut.pairs["units"].any(), "results are saved"
    second = RectifiedMatcher()
    resumed = run(pairs, THREE_UNITS, second, tmp_path / "work")
    assert matrices(resumed) == matrices(undisturbed)
    assert units(resumed) == units(undisturbed)
    calls = Counter(first.calls[:25] + second.calls)
    again = [call for call, count in calls.items() if count > 1]
    assert len(again) <= 3, "only the job that was under way runs twice"
    assert second.calls


@pytest.mark.parametrize(
    ("limit", "ending"), [(3.0, Ending.TIME_IS_UP), (math.inf, Ending.INTERRUPTED)]
)
def test_a_unit_that_never_returns_holds_the_run_neither_past_its_limit_nor_after_an_interrupt(
    tmp_path, limit, ending
):
    # Python cannot end a thread, so the run must leave it behind.
    released = threading.Event()
    interrupt = Interrupt()

    def hang() -> None:
        if ending is Ending.INTERRUPTED:
            interrupt.set()
        released.wait()

    matcher = RectifiedMatcher(matches=after_calls(5, hang))
    pairs = write_pairs(tmp_path, 12)
    try:
        report = run(
            pairs, THREE_UNITS, matcher, tmp_path / "work", limit=limit, interrupt=interrupt
        )
        assert not released.is_set(), "the run ends while the unit is under way"
        assert report.ending is ending
        assert len(report.pairs) == 12
        assert report.pairs["units"][0] > 0
    finally:
        released.set()
