"""The same runs on a Ray cluster of two machines, and what happens when one of them is lost."""

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from faulty import FaultyMatcher, die, hang
from rectified import THREE_UNITS, RectifiedMatcher, run, write_pairs
from test_faults import QUICK, matrices

from mkpc_kaggle.competition import Pair
from mkpc_kaggle.run.cluster import RayCluster
from mkpc_kaggle.run.engine import Ending, RunReport

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'mkpc-kaggle[ray]'")

TESTS = Path(__file__).parent
COUNT = 12
MEGABYTE = 1 << 20


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head and one more machine, one CPU each; joined by the runs, one after the other."""
    from ray.cluster_utils import Cluster

    patch = pytest.MonkeyPatch()
    patch.setenv("PYTHONPATH", os.pathsep.join([str(TESTS.parent), str(TESTS)]))  # what machines can import
    small = {"num_cpus": 1, "object_store_memory": 80 * MEGABYTE, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=small)
    cluster.add_node(num_cpus=1, object_store_memory=80 * MEGABYTE)
    yield cluster
    cluster.shutdown()
    patch.undo()


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> list[Pair]:
    return write_pairs(tmp_path_factory.mktemp("pairs"), COUNT)


@pytest.fixture(scope="module")
def undisturbed(pairs: list[Pair], tmp_path_factory: pytest.TempPathFactory) -> RunReport:
    return run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path_factory.mktemp("undisturbed"))


def test_actors_give_the_bytes_of_a_run_in_one_process(
    cluster: Any, pairs: list[Pair], undisturbed: RunReport, tmp_path: Path
) -> None:
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "w", workers=RayCluster(cluster.address))
    assert report.faults == ()
    assert report.ending is Ending.COMPLETE
    assert matrices(report.records) == matrices(undisturbed.records)
    assert not ray.is_initialized(), "the run lets go of the cluster"


@pytest.mark.parametrize(("fault", "told"), [(die, "the worker died: on "), (hang, "the worker hung: nothing")])
def test_an_actor_that_is_lost_is_replaced(
    cluster: Any, pairs: list[Pair], undisturbed: RunReport, tmp_path: Path, fault: Any, told: str
) -> None:
    matcher = FaultyMatcher(fault=fault, once=tmp_path / "once")
    report = run(pairs, THREE_UNITS, matcher, tmp_path / "w", workers=RayCluster(cluster.address), patience=QUICK)
    assert report.ending is Ending.COMPLETE
    assert [told in fault for fault in report.faults] == [True], report.faults
    assert matrices(report.records) == matrices(undisturbed.records)


def test_a_machine_lost_during_the_run_costs_time_alone(
    cluster: Any, pairs: list[Pair], undisturbed: RunReport, tmp_path: Path
) -> None:
    lost = cluster.add_node(num_cpus=1, object_store_memory=80 * MEGABYTE)
    matcher = RectifiedMatcher(seconds=0.2)
    threading.Timer(4.0, cluster.remove_node, (lost,)).start()
    report = run(pairs, THREE_UNITS, matcher, tmp_path / "w", workers=RayCluster(cluster.address))
    assert report.ending is Ending.COMPLETE
    print(report.faults, report.seconds)
    assert any("node has died" in fault for fault in report.faults)
    assert matrices(report.records) == matrices(undisturbed.records)
