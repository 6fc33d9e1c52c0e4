"""The same runs on a Ray cluster of two machines, and what happens when one of them is lost."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from faulty import FaultyMatcher, die
from processes import started_with
from rectified import THREE_UNITS, RectifiedMatcher, Seen, matrices, run

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.setup.assembly import Assembly

TESTS = Path(__file__).parents[1]
# What machines can import
IMPORTED = [str(TESTS.parent), str(TESTS / "engine"), str(TESTS / "support")]


ray = pytest.importorskip(
    "ray", reason="Ray is not installed: pip install 'mkpc-kaggle[ray]'"
)


TESTS = Path(__file__).parents[1]


STORE_BYTES = 80 << 20  # of each machine; Ray would take a share of the whole memory


@dataclass
class DoomedMatcher(RectifiedMatcher):
    """Marks that it has begun on the machine ``node``, where it never ends; elsewhere it waits for
    that.
    """

    node: str = ""
    mark: Path = Path()

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        if ray.get_runtime_context().get_node_id() == self.node:
            self.mark.touch()
            threading.Event().wait()
        while not self.mark.exists():
            time.sleep(0.05)
        return super()._match(seen0, seen1)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head and one more machine, one CPU each; joined by the runs, one after the other."""
    from ray.cluster_utils import Cluster

    # Machines import the tests' matchers when they unpickle them.
    patch = pytest.MonkeyPatch()
    patch.setenv("PYTHONPATH", os.pathsep.join([*IMPORTED, os.environ.get("PYTHONPATH", "")]))
    small = {"num_cpus": 1, "object_store_memory": STORE_BYTES, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=small)
    cluster.add_node(num_cpus=1, object_store_memory=STORE_BYTES)
    yield cluster
    cluster.shutdown()
    patch.undo()


# Before a test: its node sets handlers of signals, which a run must not.
@pytest.fixture(scope="module")
def lost(cluster):
    return cluster.add_node(num_cpus=1, object_store_memory=STORE_BYTES)


def test_actors_give_the_bytes_of_a_run_in_one_process_though_an_actor_dies(
    cluster, pairs, undisturbed, tmp_path
):
    matcher = FaultyMatcher(fault=die, once=tmp_path / "died")
    report = run(
        pairs, THREE_UNITS, matcher, tmp_path / "w", workers=f"ray://{cluster.address}"
    )
    assert report.ending is Ending.COMPLETE
    assert ["the worker died" in fault for fault in report.about.faults] == [True], (
        report.about.faults
    )
    assert matrices(report) == matrices(undisturbed)
    assert not ray.is_initialized(), "the run lets go of the cluster"


def test_a_machine_lost_during_the_run_costs_its_job_alone(
    cluster, lost, pairs, undisturbed, tmp_path
):
    matcher = DoomedMatcher(node=lost.node_id, mark=tmp_path / "begun")

    # Once a job is under way on it: before, the machine would only be missing.
    def lose() -> None:
        while not matcher.mark.exists():
            time.sleep(0.05)
        cluster.remove_node(lost, allow_graceful=False)

    threading.Thread(target=lose, daemon=True).start()
    report = run(
        pairs, THREE_UNITS, matcher, tmp_path / "w", workers=f"ray://{cluster.address}"
    )
    assert report.ending is Ending.COMPLETE
    assert "a job was lost on machine " in report.about.faults[0]
    assert matrices(report) == matrices(undisturbed)


def test_a_machine_that_lacks_the_weights_or_the_test_set_is_named_when_the_run_starts(
    cluster, pairs, tmp_path, monkeypatch
):
    missing = tmp_path / "nowhere"
    lacking = [Pair("a", "a", str(missing / "a.png"), str(missing / "b.png"))]
    for asked, paths in ((lacking, ()), (pairs, (missing,))):
        files = {str(path): SimpleNamespace(path=path, is_verified=True) for path in paths}
        monkeypatch.setattr(Assembly, "weight_files", files)
        with pytest.raises(
            UserError, match=f"lacks {missing}: test set and weights must have"
        ):
            run(
                asked,
                THREE_UNITS,
                RectifiedMatcher(),
                tmp_path / asked[0].id,
                workers=f"ray://{cluster.address}",
            )


LOCAL = """
import sys
sys.path[:0] = {path!r}
from pathlib import Path
from faulty import FaultyMatcher
from rectified import THREE_UNITS, run, write_pairs
from mkpc_kaggle.signals import interruptible

if __name__ == "__main__":
    home = Path(sys.argv[1])
    pairs = write_pairs(home / "pairs", 200)
    matcher = FaultyMatcher(seconds=0.1, fault=lambda: None, once=home / "begun")
    with interruptible() as interrupt:
        report = run(pairs, THREE_UNITS, matcher, home / "work", interrupt=interrupt, workers="ray")
    print(report.ending)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_cluster_that_the_run_started_ends_with_it(tmp_path, number):
    # All processes of the cluster have this in their environment.
    mark = f"MKPC_TEST={tmp_path}"
    environment = {**os.environ, "MKPC_TEST": str(tmp_path), "RAY_ADDRESS": "local"}
    environment["PYTHONPATH"] = os.pathsep.join([*IMPORTED, os.environ.get("PYTHONPATH", "")])
    running = subprocess.Popen(
        [sys.executable, "-c", LOCAL.format(path=IMPORTED), str(tmp_path)],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    while not (tmp_path / "begun").exists():
        assert running.poll() is None
        time.sleep(0.1)
    running.send_signal(number)
    told, _ = running.communicate()
    assert told == ("interrupted\n" if number is signal.SIGTERM else "")
    # Ray's agents take a minute or two to find that their node is gone.
    while [command for command in started_with(mark).values() if "Agent" not in command]:
        time.sleep(0.2)
