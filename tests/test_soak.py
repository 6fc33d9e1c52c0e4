"""A short form of ``make soak``: no process of a run grows with the number of pairs."""

import pytest

from benchmarks.soak import Process, soak
from mkpc_kaggle.geometry.coordinates import Size


@pytest.mark.slow
def test_no_process_grows_in_a_run_of_1500_pairs_that_is_resumed(tmp_path):
    # Small pictures: all fit into the caches, which may fill.
    soaked = soak(tmp_path, 1500, workers=2, interval=0.1, size=Size(64, 48))
    assert soaked.pairs == 1500
    long = [process for process in soaked.processes if process.is_long]
    parents = [process for process in long if process.name.startswith("parent")]
    # Of each half: the parent, and two workers besides one of estimates
    assert len(parents) == 2
    assert len(long) >= 6
    assert [process.name for process in long if process.grows] == []


@pytest.mark.parametrize(
    ("last", "grows"), [([300] * 3, False), ([375] * 3, False), ([300, 376, 300], True)]
)
def test_a_process_grows_if_its_last_third_is_above_the_first_half_by_5_percent_and_50_mb(
    last, grows
):
    megabytes = [200, 300, 250, 310, 310, 310, *last]
    assert Process("", [int(each * 1e6) for each in megabytes]).grows == grows
