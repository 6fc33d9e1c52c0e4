"""Workers on a Ray cluster. Ray places an actor on each GPU, or on each machine if no GPU is used.

The test set and the weights must have the same paths on every machine, as with a shared file
system. If the main machine or Ray's head node fails, rerun the command to resume from the store.
"""

import os
import signal
import socket
import textwrap
import threading
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

from mkpc_kaggle.cores import limit_matching_threads
from mkpc_kaggle.engine.places import Place, Site
from mkpc_kaggle.engine.process import EXIT_TIMEOUT_S, ThreadWorker
from mkpc_kaggle.engine.request import Answer, Cause, Failure
from mkpc_kaggle.engine.worker import Executor, Maker, MatchRunner, Message, Runner
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.setup.assembly import Assembly
from mkpc_kaggle.version import __version__


class RaySite(Site):
    """Places on the machines of a cluster; see :func:`join`.

    Each machine must have the weights, and the ``folders`` with the images. Raises
    :class:`UserError` if Ray is not installed, and if the cluster cannot be joined.
    """

    def __init__(
        self,
        assembly: Assembly,
        cluster: str,
        clock: Callable[[], float],
        folders: Iterable[Path],
        log: Path | None = None,
    ) -> None:
        super().__init__(clock, log=log)
        # Ray reads these on import. It must not report usage, or start a cluster after its
        # shutdown.
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ENABLE_AUTO_CONNECT", "0")
        try:
            import ray
        except ModuleNotFoundError as error:
            raise UserError(
                '--workers ray needs Ray, which is not installed: pip install "mkpc-kaggle[ray]"'
            ) from error
        self._ray = ray
        weights = [file.path for file in assembly.weight_files.values()]
        self._needed = (*weights, *folders)
        # A program that has joined a cluster itself keeps it after the run.
        self._has_joined = not ray.is_initialized()
        if self._has_joined:
            join(ray, cluster)
        machines = [
            node
            for node in ray.nodes()
            if node["Alive"] and node["Resources"].get("CPU", 0) >= 1
        ]
        gpus = sum(int(node["Resources"].get("GPU", 0)) for node in machines)
        # This machine belongs to the cluster, so scenes get only the cores that its actors leave.
        if gpus and assembly.device != "cpu":
            self.matching_cores = gpus
            for number in range(gpus):
                self._add(f"gpu {number}", assembly.on("cuda:0"), num_gpus=1)
        else:
            self.matching_cores = self._cores
            for number, node in enumerate(machines):
                cores = int(node["Resources"]["CPU"])
                self._add(f"machine {number}", assembly, threads=cores, num_cpus=cores)

    def close(self) -> None:
        workers = [place.worker for place in self.places if place.worker is not None]
        super().close()
        if self._has_joined and self._ray.is_initialized():
            for worker in workers:  # killed already; the threads end soon
                worker.thread.join(EXIT_TIMEOUT_S / len(workers))
            self._ray.shutdown()

    def _add(self, name: str, assembly: Assembly, threads: int = 0, **where: float) -> None:
        """Add a place for workers that need these resources of Ray."""
        limit = partial(limit_matching_threads, threads)
        runner = partial(MatchRunner, partial(Pipeline.of, assembly), limit)
        # Checked on the machine, since other versions or files would give other results silently.
        make = partial(make_alike, runner, __version__, self._needed)
        # Ray reserves a CPU for each actor by default, also for an actor with a GPU.
        resources = {"num_cpus": 0, **where}
        worker = partial(RayWorker, name, make, self.ring, self._ray, resources)
        self.places.append(Place(name, worker, minibatch=assembly.minibatch))


class RayWorker(ThreadWorker):
    """A worker in a Ray actor with the resources ``where``. The thread waits for the actor's
    answers.
    """

    _actor: Any = None

    def __init__(
        self,
        name: str,
        make: Maker,
        on_answer: Callable[[], None],
        ray: Any,
        where: dict[str, Any],
    ) -> None:
        super().__init__(name, make, on_answer)
        self._ray, self._where = ray, where

    def kill(self) -> None:
        super().kill()
        # The cluster may be gone, and the actor, too
        with suppress(self._ray.exceptions.RayError, ValueError):
            if self._actor is not None:
                self._ray.kill(self._actor)

    def _exchange(self, message: Message) -> Answer:
        if self._actor is None:
            self._actor = self._ray.remote(Executor).options(**self._where).remote()
            if self._killed:
                self.kill()
        try:
            answer: Answer = self._ray.get(self._actor.answer.remote(message))
        except self._ray.exceptions.RayError as error:
            return Failure(Cause.DIED, textwrap.shorten(str(error), 240))
        return answer


def make_alike(make: Maker, version: str, paths: tuple[Path, ...]) -> Runner:
    """Return ``make()`` on a machine of the cluster. Raise :class:`UserError` if version or paths
    differ.
    """
    host = socket.gethostname()
    if version != __version__:
        raise UserError(
            f"mkpc-kaggle is {__version__} on {host} and {version} here: install the same on both"
        )
    for path in paths:
        if not path.exists():
            raise UserError(
                f"{host} lacks {path}: test set and weights must have the same paths on every machine"
            )
    return make()


def join(ray: Any, cluster: str) -> None:
    """Connect to a cluster, ``ray`` or ``ray://HOST:PORT``. Raise :class:`UserError` if that fails.

    ``ray`` is the cluster that runs on this machine, or else a new cluster, which ends with the run. ``ray start
    --head`` prints HOST:PORT. This machine must belong to the cluster at this address.
    """
    options: dict[str, Any] = {"include_dashboard": False}
    if address := cluster.partition("://")[2]:
        options = {"address": address}
    with ExitStack() as restored:  # Ray replaces this process's signal handlers
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                restored.callback(signal.signal, number, signal.getsignal(number))
        try:
            ray.init(**options, log_to_driver=False, logging_level="ERROR")
        except (RuntimeError, ConnectionError, ValueError, OSError) as error:
            raise UserError(f"--workers {cluster}: it cannot be joined: {error}") from error
