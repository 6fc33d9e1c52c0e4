"""A pool of Ray actors, one on each GPU of a cluster, or where it has none one on each machine.

Each is looked after by a thread of the parent, as a worker process is. The parent's own machine has to last, and
Ray's head: without them there is no cluster, and another run goes on from the journal.
"""

import re
import tempfile
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from mkpc_kaggle import __version__
from mkpc_kaggle.data.images import Image, ImageStore, Unreadable, decode_image, read_image
from mkpc_kaggle.engine.jobs import Cause, Job, Lost
from mkpc_kaggle.engine.pools.cluster import RayCluster, own_signals
from mkpc_kaggle.engine.pools.processes import START_SECONDS, Answer, ProcessPool, answer_of
from mkpc_kaggle.engine.worker import Bench
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.weights import FoundFile, State, WeightStore
from mkpc_kaggle.weights.digests import file_digests
from mkpc_kaggle.weights.unpacked import digest_of

REPLY_SECONDS = 20.0
"""How long an actor may take to say a word while it matches. Longer, and its machine or interpreter is stuck."""
LONGEST_WAIT = 3600.0
"""Ray takes no endless waits; this one is repeated."""
THREADS = 4
"""Of an actor: one matches, the others hear what it is told meanwhile."""

Stamp = tuple[int, int]
Fetch = Callable[[Path, Stamp | None], bytes | None]


class RayPool(ProcessPool):
    """Matching in actors; F is estimated in the parent, in threads, while they go on matching."""

    def __init__(self, assembly: Assembly, cluster: RayCluster) -> None:
        super().__init__((), assembly.recipe)
        self._assembly = assembly
        self._cluster = cluster
        self._joined = False

    def start(self) -> None:
        self._joined = not ray.is_initialized()
        if self._joined:
            join(self._cluster)
        floor = Floor(self._assembly)
        self._take_on([RaySeat(f"actor {number}", floor) for number, _ in enumerate(floor.places())])
        super().start()

    def close(self) -> bool:
        at_rest = super().close()
        if self._joined and ray.is_initialized():
            ray.shutdown()
        return at_rest


def join(cluster: RayCluster) -> None:
    """Connect to the cluster; raises :class:`UserError` where that fails."""
    options: dict[str, Any] = {"include_dashboard": False}
    if cluster.address:
        cluster.require_reachable()
        options = {"address": cluster.address}
    with own_signals():
        try:
            ray.init(**options, log_to_driver=False, logging_level="ERROR")
        except (RuntimeError, ConnectionError, ValueError, OSError) as error:
            raise UserError(f"the Ray cluster cannot be joined: {error}") from error


@dataclass(frozen=True)
class Place:
    """Where one actor may be: on a machine's CPUs, ``threads`` of them, or on one of its GPUs."""

    node: str
    host: str
    number: int
    threads: int
    gpu: bool


def places_of(nodes: Iterable[Mapping[str, Any]], device: str) -> list[Place]:
    """The places of a cluster, as ``ray.nodes()`` tells of it.

    A machine that offers no CPUs is not worked on; ``device`` "cpu" keeps the work off GPUs.
    """
    offers = [(node, node["Resources"]) for node in nodes if node["Alive"]]
    gpu = device != "cpu" and any(offer.get("GPU", 0) >= 1 for _, offer in offers)
    places = []
    for node, offer in offers:
        count = int(offer.get("GPU", 0)) if gpu else int(offer.get("CPU", 0) >= 1)
        threads = max(1, int(offer.get("CPU", 0)) // max(1, count))
        places += [
            Place(node["NodeID"], node["NodeManagerHostname"], number, threads, gpu) for number in range(count)
        ]
    return places


class Floor:
    """The cluster's places, each taken by one actor at most."""

    def __init__(self, assembly: Assembly) -> None:
        self._assembly = assembly
        self._taken: set[Place] = set()
        self._lock = threading.Lock()
        here = ray.get_runtime_context().get_node_id()
        self._library = (
            ray.remote(Library)
            .options(num_cpus=0, max_restarts=-1, max_task_retries=-1, scheduling_strategy=on_node(here))
            .remote()
        )

    def places(self) -> list[Place]:
        """All places that there are now; raises :class:`UserError` where there are none."""
        places = places_of(ray.nodes(), self._assembly.device)
        if not places:
            raise UserError("the Ray cluster offers neither a CPU nor a GPU")
        return places

    def take(self) -> Place | None:
        """A place that is free; ``None`` where machines were lost and what is left is taken."""
        with self._lock:
            places = places_of(ray.nodes(), self._assembly.device)
            place = next((place for place in places if place not in self._taken), None)
            if place is not None:
                self._taken.add(place)
            return place

    def leave(self, place: Place) -> None:
        with self._lock:
            self._taken.discard(place)

    def stands(self, place: Place) -> bool:
        """Is the machine still there?"""
        return any(node["Alive"] for node in ray.nodes() if node["NodeID"] == place.node)

    def actor(self, place: Place) -> Any:
        """An actor in that place, and nowhere else."""
        assembly = self._assembly.on("cuda:0") if place.gpu else self._assembly
        return (
            ray.remote(RemoteBench)
            .options(
                num_cpus=0 if place.gpu else place.threads,
                num_gpus=int(place.gpu),
                max_concurrency=THREADS,
                scheduling_strategy=on_node(place.node),
            )
            .remote(assembly, place.threads, self._library)
        )


def on_node(node: str) -> Any:
    return NodeAffinitySchedulingStrategy(node, soft=False)


@dataclass(frozen=True)
class RaySeat:
    """Has actors made, one after the other, wherever there is a place."""

    name: str
    floor: Floor

    def hire(self) -> "RayWorker":
        return RayWorker(self.floor)


@dataclass(frozen=True)
class Silence:
    """Why an actor did not answer."""

    cause: Cause
    text: str


class RayWorker:
    """An actor as its keeper sees it."""

    def __init__(self, floor: Floor) -> None:
        self._floor = floor
        self._place = floor.take()
        self._actor = None if self._place is None else floor.actor(self._place)

    def load(self) -> str:
        """Wait until the matchers are loaded; empty, or why they are not. Raises the :class:`UserError` it met."""
        if self._actor is None:
            return "no machine of the cluster is free for it"
        answer = self._answer(self._actor.load.remote(__version__), START_SECONDS)
        if isinstance(answer, UserError):
            raise answer
        return f"{answer.cause}: {answer.text}" if isinstance(answer, Silence) else ""

    def do(self, job: Job) -> Answer:
        """Its answer, or what became of it."""
        assert self._actor is not None, "only a worker that was loaded gets jobs"
        sent, timeout = time.monotonic(), job.plan.timeout
        coming = self._actor.match.remote(job, job.plan.deadline - sent)
        left = timeout
        while left > 0:
            answer: Answer | Silence = self._answer(coming, min(left, LONGEST_WAIT))
            if not isinstance(answer, Silence):
                return answer
            if answer.cause is not Cause.HUNG:
                return Lost(job, answer.cause, answer.text)
            left = timeout - min(self._silent_for(), time.monotonic() - sent)
        return Lost(job, Cause.HUNG, f"nothing heard for {timeout:.0f} s")

    def announce(self, paths: Iterable[Path]) -> None:
        """Tell it to decode these ahead."""
        if self._actor is not None:
            self._actor.announce.remote(tuple(paths))

    def stop(self) -> None:
        if self._actor is not None:
            self._actor.stop.remote()

    def kill(self) -> None:
        if self._actor is None or self._place is None:
            return
        with suppress(
            ray.exceptions.RayError
        ):  # the cluster may have been let go of meanwhile, its actors with it
            ray.kill(self._actor)
        self._floor.leave(self._place)

    def _silent_for(self) -> float:
        """Seconds since it last began a unit; for ever, if it does not even say that."""
        assert self._actor is not None
        answer = self._answer(self._actor.silent_for.remote(), REPLY_SECONDS)
        return float("inf") if isinstance(answer, Silence) else float(answer)

    def _answer(self, coming: Any, seconds: float) -> Any:
        """What it answers, or :class:`Silence`."""
        try:
            return ray.get(coming, timeout=seconds)
        except ray.exceptions.GetTimeoutError:
            return Silence(Cause.HUNG, f"nothing heard for {seconds:.0f} s")
        except ray.exceptions.OutOfMemoryError as error:
            return Silence(Cause.OUT_OF_MEMORY, self._told(error))
        except ray.exceptions.RayError as error:
            stands = self._place is not None and self._floor.stands(self._place)
            return Silence(Cause.DIED if stands else Cause.MACHINE, self._told(error))

    def _told(self, error: Exception) -> str:
        """Where it was and what Ray says of it, shortened: Ray is lengthy, and begins with its own ids."""
        lines = [line for line in str(error).splitlines() if not re.match(r"\t\w+: ", line)]
        host = self._place.host if self._place is not None else ""
        return f"on {host}: {textwrap.shorten(' '.join(lines[1:] or lines), 240)}"


class Library:
    """The files of the parent's machine, read for those that lack them."""

    def fetch(self, path: Path, stamp: Stamp | None) -> bytes | None:
        """The file's bytes; ``None`` where its stamp is ``stamp``. Raises ``OSError``."""
        return None if stamp is not None and stamp == stamp_of(path) else path.read_bytes()


def stamp_of(path: Path) -> Stamp | None:
    """Size in bytes and time of change in nanoseconds: the same where a path leads to the same file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


class RemoteBench:
    """What lives in an actor: a bench whose images and weights come from shared paths, or else from the parent."""

    def __init__(self, assembly: Assembly, threads: int, library: Any) -> None:
        self._assembly = assembly
        self._threads = threads
        self._library = library
        self._heard = time.monotonic()
        self._weights = WeightStore()
        self._bench = Bench(self._pipeline, ImageStore(read=lambda path: read_or_fetch(path, self._fetch)))

    def load(self, version: str) -> str | UserError:
        """Empty; or what the user has to mend."""
        if version != __version__:
            host = ray.util.get_node_ip_address()
            return UserError(
                f"mkpc-kaggle is {__version__} on {host} and {version} here: install the same on both"
            )
        use_threads(self._threads)
        try:
            with tempfile.TemporaryDirectory() as home:
                self._weights = local_store(self._assembly, Path(home), self._fetch)
                self._bench.load()
        except UserError as error:
            return error
        return ""

    def match(self, job: Job, seconds: float) -> Answer:
        self._hear()
        return answer_of(self._bench, job, seconds, self._hear)

    def silent_for(self) -> float:
        """Seconds since it last began something."""
        return time.monotonic() - self._heard

    def announce(self, paths: tuple[Path, ...]) -> None:
        self._bench.announce(paths)

    def stop(self) -> None:
        self._bench.stop()

    def _hear(self) -> None:
        self._heard = time.monotonic()

    def _fetch(self, path: Path, stamp: Stamp | None) -> bytes | None:
        found: bytes | None = ray.get(self._library.fetch.remote(path, stamp))
        return found

    def _pipeline(self) -> Pipeline:
        return replace(self._assembly, weights=self._weights).pipeline()


def read_or_fetch(path: Path, fetch: Fetch) -> Image | Unreadable:
    """The image at ``path`` of the parent's machine: read here if the path leads to it here too; never raises."""
    try:
        data = fetch(path, stamp_of(path))
    except FileNotFoundError:
        return Unreadable(str(path), "no such file")
    except (OSError, ray.exceptions.RayError) as error:
        return Unreadable(str(path), f"cannot be fetched: {error}")
    return read_image(path) if data is None else decode_image(str(path), np.frombuffer(data, np.uint8))


def local_store(assembly: Assembly, home: Path, fetch: Fetch) -> WeightStore:
    """A store of the weights that the parent found, put into ``home``: links to those that are here, or copies."""
    for found in assembly.weight_files.values():
        target = home / found.file.name
        if is_here(found):
            target.symlink_to(found.path)
        elif found.state is State.UNPACKED:
            raise UserError(f"{found.path} cannot be sent to other machines: {found.note}")
        else:
            data = fetch(found.path, None)
            assert data is not None
            target.write_bytes(data)
    return WeightStore([home], assembly.weights.files)


def is_here(found: FoundFile) -> bool:
    try:
        unpacked = found.state is State.UNPACKED
        return (digest_of(found.path) if unpacked else file_digests(found.path).sha256) == found.digest
    except OSError:
        return False


def use_threads(count: int) -> None:
    import torch

    torch.set_num_threads(count)
    cv2.setNumThreads(count)
