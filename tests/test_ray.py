"""The same runs on a Ray cluster of two machines, and what happens when one of them is lost."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from faulty import FarMatcher, FaultyMatcher, die, hang, nothing
from mkpc_kaggle.engine.pools.cluster import RayCluster
from rectified import THREE_UNITS, RectifiedMatcher, run, write_pairs
from synthetic import RECIPE as SYNTHETIC
from synthetic import SyntheticMatcher, synthetic_pairs
from test_faults import QUICK, matrices

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.engine import Ending, RunReport

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'mkpc-kaggle[ray]'")

TESTS = Path(__file__).parent
IMPORTED = [str(TESTS.parent), str(TESTS / "support")]
"""What machines can import."""
COUNT = 12
MEGABYTE = 1 << 20


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head and one more machine, one CPU each; joined by the runs, one after the other."""
    from ray.cluster_utils import Cluster

    patch = pytest.MonkeyPatch()
    patch.setenv("PYTHONPATH", os.pathsep.join(IMPORTED))
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
    report = run(pairs, THREE_UNITS, matcher, tmp_path / "w", workers=RayCluster(cluster.address), timeouts=QUICK)
    assert report.ending is Ending.COMPLETE
    assert [told in fault for fault in report.faults] == [True], report.faults
    assert matrices(report.records) == matrices(undisturbed.records)


def test_a_machine_lost_during_the_run_costs_time_alone(cluster: Any, tmp_path: Path) -> None:
    pairs = write_pairs(tmp_path / "pairs", 40)
    undisturbed = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "undisturbed")
    lost = cluster.add_node(num_cpus=1, object_store_memory=80 * MEGABYTE)
    matcher = FaultyMatcher(fault=nothing, at=20, seconds=0.1, once=tmp_path / "begun")

    def lose() -> None:
        while not (tmp_path / "begun").exists():
            time.sleep(0.05)
        cluster.remove_node(lost)

    threading.Thread(target=lose, daemon=True).start()
    report = run(pairs, THREE_UNITS, matcher, tmp_path / "w", workers=RayCluster(cluster.address))
    assert report.ending is Ending.COMPLETE
    assert "the machine was lost: on " in report.faults[0]
    assert all("the machine was lost" in fault or "could be started" in fault for fault in report.faults)
    assert matrices(report.records) == matrices(undisturbed.records)


def kill_the_first_scene_actor(cluster: Any, report: list[str]) -> None:
    """Wait until it is there, and note where it was."""
    while not report:
        for process in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                told = process.read_text()
            except OSError:
                continue
            if "SceneActor" in told:
                os.kill(int(process.parent.name), signal.SIGKILL)
                report.append(told)
                return
        time.sleep(0.02)


@pytest.fixture(scope="module")
def batch(tmp_path_factory: pytest.TempPathFactory) -> list[Pair]:
    return synthetic_pairs(tmp_path_factory.mktemp("batch"))


def test_batches_are_reconstructed_on_the_cluster_to_the_same_bytes(
    cluster: Any, batch: list[Pair], tmp_path: Path
) -> None:
    here = run(batch, SYNTHETIC, SyntheticMatcher(), tmp_path / "here")
    report = run(batch, SYNTHETIC, SyntheticMatcher(), tmp_path / "w", workers=RayCluster(cluster.address))
    assert report.faults == ()
    assert [record.source for record in report.records] == ["scene"] * len(batch)
    assert [one.fundamental.tobytes() for one in report.records] == [
        one.fundamental.tobytes() for one in here.records
    ]


def test_a_reconstruction_that_dies_on_the_cluster_costs_its_scene_alone(
    cluster: Any, batch: list[Pair], tmp_path: Path
) -> None:
    killed: list[str] = []
    threading.Thread(target=kill_the_first_scene_actor, args=(cluster, killed), daemon=True).start()
    report = run(batch, SYNTHETIC, SyntheticMatcher(), tmp_path / "w", workers=RayCluster(cluster.address))
    killed.append("the run is over")
    assert report.ending is Ending.COMPLETE
    assert [record.source for record in report.records] == ["pair"] * len(batch)
    assert "batch batch was not reconstructed: on " in report.faults[0]


def test_images_are_sent_to_machines_that_cannot_read_them(
    cluster: Any, pairs: list[Pair], undisturbed: RunReport, tmp_path: Path
) -> None:
    report = run(pairs, THREE_UNITS, FarMatcher(), tmp_path / "w", workers=RayCluster(cluster.address))
    assert report.faults == ()
    assert matrices(report.records) == matrices(undisturbed.records)


def test_an_image_is_read_here_only_if_it_is_the_same_file(tmp_path: Path) -> None:
    from mkpc_kaggle.engine.pools.ray_actor import FileServer, read_or_fetch

    from mkpc_kaggle.data.images import Image, Unreadable

    pair, other = write_pairs(tmp_path, 2)
    server, asked = FileServer(), []

    def fetch(path: Path, stamp: tuple[int, int] | None) -> bytes | None:
        asked.append(server.fetch(path, stamp))
        return asked[-1]

    def fetch_another(_: Path, stamp: tuple[int, int] | None) -> bytes | None:
        return server.fetch(other.image0, stamp)

    os.utime(other.image0, (1, 1))
    here = read_or_fetch(pair.image0, fetch)
    sent = read_or_fetch(pair.image0, fetch_another)
    assert asked == [None], "nothing is sent"
    assert isinstance(here, Image)
    assert isinstance(sent, Image)
    assert (int(here.pixels.max()), int(sent.pixels.max())) == (10, 11)
    nowhere = read_or_fetch(tmp_path / "no.png", fetch)
    assert nowhere == Unreadable(str(tmp_path / "no.png"), "no such file")


def node(name: str, alive: bool = True, **offer: float) -> dict[str, Any]:
    return {"NodeID": name, "NodeManagerHostname": name, "Alive": alive, "Resources": offer}


@pytest.mark.parametrize(
    ("device", "expected"),
    [
        ("auto", [("gpus", 0, 4, True), ("gpus", 1, 4, True)]),
        ("cpu", [("cpus", 0, 6, False), ("gpus", 0, 8, False)]),
    ],
)
def test_places_are_the_gpus_or_else_the_machines(device: str, expected: list[tuple[str, int, int, bool]]) -> None:
    from mkpc_kaggle.engine.pools.ray_pool import slots_of

    nodes = [
        node("cpus", CPU=6),
        node("gone", alive=False, CPU=6, GPU=1),
        node("gpus", CPU=8, GPU=2),
        node("head"),
    ]
    slots = slots_of(nodes, device)
    assert [(slot.node, slot.number, slot.threads, slot.gpu) for slot in slots] == expected


LOCAL = """
import sys, time
sys.path[:0] = {path!r}
from pathlib import Path
from rectified import THREE_UNITS, RectifiedMatcher, write_pairs
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.pools.cluster import RayCluster
from mkpc_kaggle.engine.session import Session, interruptible, run_pairs

home = Path(sys.argv[1])
pairs = write_pairs(home / "pairs", 200)
assembly = assemble(THREE_UNITS, matchers={{"rectified": RectifiedMatcher(seconds=0.1)}}, device="cpu")

def publish(records):
    (home / "begun").touch()

with interruptible() as interrupt:
    session = Session(home / "work", Budget(time.monotonic()), interrupt, progress=False, workers=RayCluster())
    report, _ = run_pairs(pairs, assembly, session, publish)
print(report.ending)
"""


def processes_of(mark: str) -> list[str]:
    """Processes that were started with that in their environment."""
    found = []
    for environment in Path("/proc").glob("[0-9]*/environ"):
        try:
            if mark.encode() in environment.read_bytes():
                found.append((environment.parent / "cmdline").read_text().replace("\0", " ")[:80])
        except OSError:
            continue
    return found


def at_work(mark: str) -> list[str]:
    """Those processes but for Ray's agents, which take a minute or two to find that their node is gone."""
    return [line for line in processes_of(mark) if "Agent" not in line]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_cluster_of_its_own_ends_with_the_run(tmp_path: Path, number: signal.Signals) -> None:
    mark = f"MKPC_TEST={tmp_path}"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(IMPORTED), "MKPC_TEST": str(tmp_path)}
    environment["RAY_ADDRESS"] = "local"
    running = subprocess.Popen(
        [sys.executable, "-c", LOCAL.format(path=IMPORTED), str(tmp_path)],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 60
    while not any("WorkerActor" in line for line in processes_of(mark)) and time.monotonic() < deadline:
        time.sleep(0.2)
    time.sleep(2.0)
    running.send_signal(number)
    told, _ = running.communicate(timeout=60)
    assert told == ("interrupted\n" if number is signal.SIGTERM else "")
    deadline = time.monotonic() + 60
    while at_work(mark) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert at_work(mark) == []
