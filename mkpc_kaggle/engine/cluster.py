"""Workers on a Ray cluster: an actor for each GPU, or for each machine if there is none; Ray places them.

The test set and the weights have the same paths on every machine, as on clusters with a shared file system. The
parent's machine has to last, and Ray's head: without them another run goes on from the journal.
"""

import os
import re
import signal
import socket
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mkpc_kaggle import __version__
from mkpc_kaggle.engine.jobs import Answer, Cause, Failure, Job
from mkpc_kaggle.engine.places import LISTEN_S, Place, Site
from mkpc_kaggle.engine.worker import MatchRunner, Runner, SceneRunner, load, run
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.assembly import Assembly

FORMS = "a number of processes, ray (this machine's cluster, or one for this run), ray://HOST:PORT"
REACH_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class RayCluster:
    """The Ray cluster to work on.

    ``address``, HOST:PORT, is the one that ``ray start --head`` prints; this machine must be one of the cluster's.
    Empty: the cluster that runs on this machine, or else one that is started for the run and ends with it.
    """

    address: str = ""

    def require_reachable(self) -> None:
        """Raise :class:`UserError` where nothing listens at the address: Ray itself tries for minutes."""
        host, _, port = self.address.rpartition(":")
        try:
            socket.create_connection((host, int(port)), timeout=REACH_TIMEOUT_S).close()
        except OSError as error:
            raise UserError(
                f"--workers ray://{self.address}: no cluster answers there ({error.strerror or error}). Start one "
                "with `ray start --head` and join it from the other machines; it prints the address to use."
            ) from error


def parse_workers(text: str) -> int | RayCluster:
    """What the user wrote; raises :class:`UserError` that lists the forms for anything else."""
    if re.fullmatch(r"\d{1,3}", text):
        return int(text)
    if text == "ray":
        return RayCluster()
    found = re.fullmatch(r"ray://([^/\s]+:\d{1,5})", text)
    if found is None:
        raise UserError(f"--workers: {text!r} is none of: {FORMS}")
    return RayCluster(found[1])


def ray_site(
    assembly: Assembly, cluster: RayCluster, clock: Callable[[], float], folders: tuple[Path, ...] = ()
) -> Site:
    """The cluster's site; raises :class:`UserError` where Ray is not installed.

    Each machine must have the weights and the ``folders``, which hold the images.
    """
    # Read when Ray is imported: it must not report usage, and not start a cluster after it was shut down.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ENABLE_AUTO_CONNECT", "0")
    try:
        import ray  # noqa: F401
    except ModuleNotFoundError as error:
        told = '--workers ray needs Ray, which is not installed: pip install "mkpc-kaggle[ray]"'
        raise UserError(told) from error
    return RaySite(assembly, cluster, clock, (*assembly.weight_paths, *folders))


class RaySite:
    """The machines of a cluster, which is joined when the site is opened. See :class:`Site`."""

    def __init__(
        self, assembly: Assembly, cluster: RayCluster, clock: Callable[[], float], needed: tuple[Path, ...]
    ) -> None:
        self.places: list[Place] = []
        self.fallback: list[Place] = []
        self._assembly = assembly
        self._cluster = cluster
        self._clock = clock
        self._needed = needed
        self.scenes_at_once = 1  # one on each machine
        self._has_joined = False
        self._coming: set[Any] = set()

    def open(self) -> None:
        import ray

        self._has_joined = not ray.is_initialized()
        if self._has_joined:
            join(self._cluster)
        machines = [node for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU", 0) >= 1]
        self.scenes_at_once = max(1, len(machines))
        gpus = sum(int(node["Resources"].get("GPU", 0)) for node in machines)
        if gpus and self._assembly.device != "cpu":
            make = partial(MatchRunner, self._assembly.on("cuda:0").pipeline)
            self.places = [self._place(f"gpu {number}", make, num_cpus=0, num_gpus=1) for number in range(gpus)]
        else:
            make = partial(MatchRunner, self._assembly.pipeline)
            for number, node in enumerate(machines):  # of which several may have one name
                name = f"machine {number} ({node['NodeManagerHostname']})"
                self.places.append(self._place(name, make, num_cpus=int(node["Resources"]["CPU"])))
        if not self.places:
            raise UserError("the Ray cluster offers neither a CPU nor a GPU")

    def scene_worker(self) -> "RayWorker":
        anywhere = {"num_cpus": 0, "scheduling_strategy": "SPREAD"}
        return RayWorker(SceneRunner, anywhere, self._needed, self._coming)

    def wait(self, until: float) -> None:
        seconds = max(0.0, min(LISTEN_S, until - self._clock()))
        if self._coming:
            import ray

            ray.wait(list(self._coming), timeout=seconds)
        else:
            time.sleep(seconds)

    def close(self) -> None:
        import ray

        if self._has_joined and ray.is_initialized():
            ray.shutdown()

    def _place(self, name: str, make: Callable[[], Runner], **where: Any) -> Place:
        return Place(name, partial(RayWorker, make, where, self._needed, self._coming))


class RayWorker:
    """An actor; see :class:`mkpc_kaggle.engine.jobs.Worker`. ``coming`` are the answers of all to come."""

    def __init__(
        self, make: Callable[[], Runner], where: dict[str, Any], paths: tuple[Path, ...], coming: set[Any]
    ) -> None:
        self._make, self._where, self._paths, self._all_coming = make, where, paths, coming
        self._actor: Any = None
        self._coming: Any = None

    def start(self) -> None:
        import ray

        threads = int(self._where.get("num_cpus", 0))
        self._actor = ray.remote(Actor).options(**self._where).remote()
        self._expect(self._actor.load.remote(__version__, self._make, self._paths, threads))

    def submit(self, job: Job, seconds: float) -> None:
        self._expect(self._actor.run.remote(job, seconds))

    def answer(self) -> Answer | None:
        import ray

        if self._coming is None or not ray.wait([self._coming], timeout=0)[0]:
            return None
        coming, self._coming = self._coming, None
        self._all_coming.discard(coming)
        try:
            answer: Answer = ray.get(coming)
        except ray.exceptions.RayError as error:
            is_memory = isinstance(error, ray.exceptions.OutOfMemoryError)
            return Failure(Cause.OUT_OF_MEMORY if is_memory else Cause.DIED, message_of(error))
        return answer

    def kill(self) -> None:
        import ray

        self._all_coming.discard(self._coming)
        self._coming = None
        with suppress(ray.exceptions.RayError, ValueError):  # the cluster may be gone, its actors with it
            ray.kill(self._actor)

    def _expect(self, coming: Any) -> None:
        self._coming = coming
        self._all_coming.add(coming)


class Actor:
    """A worker's process on a machine of the cluster."""

    def __init__(self) -> None:
        self._runner: Runner | None = None

    def load(self, version: str, make: Callable[[], Runner], paths: tuple[Path, ...], threads: int) -> Answer:
        """Load the matchers where version and paths are those of the parent's machine."""
        host = socket.gethostname()
        if version != __version__:
            told = f"mkpc-kaggle is {__version__} on {host} and {version} here: install the same on both"
            return Failure(Cause.REFUSED, told)
        missing = next((path for path in paths if not path.exists()), None)
        if missing is not None:
            told = f"{host} lacks {missing}: test set and weights must have the same paths on every machine"
            return Failure(Cause.REFUSED, told)
        if threads:
            import cv2
            import torch

            torch.set_num_threads(threads)
            cv2.setNumThreads(threads)
        self._runner, answer = load(make)
        return answer

    def run(self, job: Job, seconds: float) -> Answer:
        assert self._runner is not None, "only a worker that has loaded gets jobs"
        return run(self._runner, job, seconds)


def join(cluster: RayCluster) -> None:
    """Connect to the cluster; raises :class:`UserError` where that fails."""
    import ray

    options: dict[str, Any] = {"include_dashboard": False}
    if cluster.address:
        cluster.require_reachable()
        options = {"address": cluster.address}
    with own_signals():
        try:
            ray.init(**options, log_to_driver=False, logging_level="ERROR")
        except (RuntimeError, ConnectionError, ValueError, OSError) as error:
            raise UserError(f"the Ray cluster cannot be joined: {error}") from error


@contextmanager
def own_signals() -> Iterator[None]:
    """Keep this process's answers to signals, which Ray replaces by its own when it starts."""
    former = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in former.items():
                signal.signal(number, handler)


def message_of(error: Exception) -> str:
    """What Ray says of an error, shortened: Ray is lengthy, and begins with its own ids."""
    lines = [line for line in str(error).splitlines() if not re.match(r"\t\w+: ", line)]
    return textwrap.shorten(" ".join(lines[1:] or lines), 240)
