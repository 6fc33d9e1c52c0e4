"""A pool of Ray actors, one on each GPU of a cluster, or where it has none one on each machine.

The parent's own machine has to last, and Ray's head: without them there is no cluster, and another run goes on
from the journal.
"""

import re
import textwrap
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from mkpc_kaggle import __version__
from mkpc_kaggle.engine.jobs import Cause, Job, JobFailure
from mkpc_kaggle.engine.pools.cluster import RayCluster, own_signals
from mkpc_kaggle.engine.pools.pool import START_SECONDS, Place, Pool
from mkpc_kaggle.engine.pools.ray_actor import FileServer, SceneActor, WorkerActor
from mkpc_kaggle.engine.scenes import Reconstruction, SceneAnswer, SceneJob
from mkpc_kaggle.engine.worker import Answer
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.assembly import Assembly

REPLY_SECONDS = 20.0
"""How long an actor may take to answer while it matches. Longer, and its machine or interpreter is stuck."""
LONGEST_WAIT = 3600.0
"""Ray takes no endless waits; this one is repeated."""
THREADS = 4
"""Of an actor: one matches, the others take messages meanwhile."""


class RayPool(Pool):
    """A pool whose workers are actors; the cluster is joined when it starts."""

    def __init__(self, assembly: Assembly, cluster: RayCluster) -> None:
        super().__init__((), assembly.recipe)
        self._assembly = assembly
        self._cluster = cluster
        self._joined = False
        self._slots: Slots | None = None

    def start(self) -> str:
        self._joined = not ray.is_initialized()
        if self._joined:
            join(self._cluster)
        self._slots = Slots(self._assembly)
        start = partial(RayWorker, self._slots)
        self._settle([Place(f"actor {number}", start) for number, _ in enumerate(self._slots.all())])
        return super().start()

    @property
    def scenes_at_once(self) -> int:
        """One on each machine."""
        return max(1, len(self._slots.machines())) if self._slots is not None else super().scenes_at_once

    def reconstruct(self, job: SceneJob) -> Reconstruction:
        """On a machine of the cluster; here in a run that had nothing to match, and joined none."""
        return super().reconstruct(job) if self._slots is None else RayScene(self._slots, job)

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
class Slot:
    """Where one actor may be: on a machine's CPUs, ``threads`` of them, or on one of its GPUs."""

    node: str
    host: str
    number: int
    threads: int
    gpu: bool


def slots_of(nodes: Iterable[Mapping[str, Any]], device: str) -> list[Slot]:
    """The slots of a cluster, as ``ray.nodes()`` lists them.

    A machine that offers no CPUs is not worked on; ``device`` "cpu" keeps the work off GPUs.
    """
    offers = [(node, node["Resources"]) for node in nodes if node["Alive"]]
    gpu = device != "cpu" and any(offer.get("GPU", 0) >= 1 for _, offer in offers)
    slots = []
    for node, offer in offers:
        count = int(offer.get("GPU", 0)) if gpu else int(offer.get("CPU", 0) >= 1)
        threads = max(1, int(offer.get("CPU", 0)) // max(1, count))
        slots += [
            Slot(node["NodeID"], node["NodeManagerHostname"], number, threads, gpu) for number in range(count)
        ]
    return slots


class Slots:
    """The cluster's slots, each taken by one actor at most; ``scenes`` counts those under way on each machine."""

    def __init__(self, assembly: Assembly) -> None:
        self._assembly = assembly
        self._taken: set[Slot] = set()
        self.scenes: Counter[str] = Counter()
        self._lock = threading.Lock()
        here = ray.get_runtime_context().get_node_id()
        self._files = (
            ray.remote(FileServer)
            .options(num_cpus=0, max_restarts=-1, max_task_retries=-1, scheduling_strategy=on_node(here))
            .remote()
        )

    def all(self) -> list[Slot]:
        """All slots that there are now; raises :class:`UserError` where there are none."""
        slots = slots_of(ray.nodes(), self._assembly.device)
        if not slots:
            raise UserError("the Ray cluster offers neither a CPU nor a GPU")
        return slots

    def take(self) -> Slot | None:
        """A slot that is free; ``None`` where machines were lost and what is left is taken."""
        with self._lock:
            slots = slots_of(ray.nodes(), self._assembly.device)
            slot = next((slot for slot in slots if slot not in self._taken), None)
            if slot is not None:
                self._taken.add(slot)
            return slot

    def machines(self) -> list[Slot]:
        """A slot of each machine that there is now, taken or not."""
        return list({slot.node: slot for slot in slots_of(ray.nodes(), self._assembly.device)}.values())

    def release(self, slot: Slot) -> None:
        with self._lock:
            self._taken.discard(slot)

    def is_alive(self, slot: Slot) -> bool:
        """Is the machine still there?"""
        return any(node["Alive"] for node in ray.nodes() if node["NodeID"] == slot.node)

    def scene_actor(self, slot: Slot) -> Any:
        """An actor for one batch on that slot's machine, beside the worker."""
        where = on_node(slot.node)
        return ray.remote(SceneActor).options(num_cpus=0, scheduling_strategy=where).remote(self._files)

    def actor(self, slot: Slot) -> Any:
        """An actor in that slot, and nowhere else."""
        assembly = self._assembly.on("cuda:0") if slot.gpu else self._assembly
        return (
            ray.remote(WorkerActor)
            .options(
                num_cpus=0 if slot.gpu else slot.threads,
                num_gpus=int(slot.gpu),
                max_concurrency=THREADS,
                scheduling_strategy=on_node(slot.node),
            )
            .remote(assembly, slot.threads, self._files)
        )


def on_node(node: str) -> Any:
    return NodeAffinitySchedulingStrategy(node, soft=False)


@dataclass(frozen=True)
class NoAnswer:
    """Why an actor did not answer."""

    cause: Cause
    message: str


class RayWorker:
    """An actor as its supervisor sees it."""

    killable: ClassVar = True

    def __init__(self, slots: Slots) -> None:
        self._slots = slots
        self._slot = slots.take()
        self._actor = None if self._slot is None else slots.actor(self._slot)

    def load(self) -> str:
        if self._actor is None:
            return "no machine of the cluster is free for it"
        answer = self._answer(self._actor.load.remote(__version__), START_SECONDS)
        if isinstance(answer, UserError):
            raise answer
        return f"{answer.cause}: {answer.message}" if isinstance(answer, NoAnswer) else ""

    def run(self, job: Job) -> Answer:
        assert self._actor is not None, "only a worker that was loaded gets jobs"
        sent, timeout = time.monotonic(), job.timeout
        coming = self._actor.run.remote(job, job.deadline - sent)
        left = timeout
        while left > 0:
            answer: Answer | NoAnswer = self._answer(coming, min(left, LONGEST_WAIT))
            if not isinstance(answer, NoAnswer):
                return answer
            if answer.cause is not Cause.HUNG:
                return JobFailure(job, answer.cause, answer.message)
            left = timeout - min(self._silent_for(), time.monotonic() - sent)
        return JobFailure(job, Cause.HUNG, f"nothing heard for {timeout:.0f} s")

    def prefetch(self, paths: Iterable[Path]) -> None:
        if self._actor is not None:
            self._actor.prefetch.remote(tuple(paths))

    def stop(self) -> None:
        if self._actor is not None:
            self._actor.stop.remote()

    def kill(self) -> None:
        if self._actor is None or self._slot is None:
            return
        # The cluster may have been left meanwhile, its actors with it.
        with suppress(ray.exceptions.RayError):
            ray.kill(self._actor)
        self._slots.release(self._slot)

    def _silent_for(self) -> float:
        """Seconds since it last began a unit; for ever, if it does not even say that."""
        assert self._actor is not None
        answer = self._answer(self._actor.silent_for.remote(), REPLY_SECONDS)
        return float("inf") if isinstance(answer, NoAnswer) else float(answer)

    def _answer(self, coming: Any, seconds: float) -> Any:
        """What it answers, or why there is none."""
        try:
            return ray.get(coming, timeout=seconds)
        except ray.exceptions.GetTimeoutError:
            return NoAnswer(Cause.HUNG, f"nothing heard for {seconds:.0f} s")
        except ray.exceptions.OutOfMemoryError as error:
            return NoAnswer(Cause.OUT_OF_MEMORY, self._message(error))
        except ray.exceptions.RayError as error:
            alive = self._slot is not None and self._slots.is_alive(self._slot)
            return NoAnswer(Cause.DIED if alive else Cause.MACHINE, self._message(error))

    def _message(self, error: Exception) -> str:
        return message_of(error, self._slot.host if self._slot is not None else "")


class RayScene:
    """A batch under way in an actor of its own; begun again on another machine where its own is lost.

    See :class:`mkpc_kaggle.engine.scenes.Reconstruction`.
    """

    def __init__(self, slots: Slots, job: SceneJob) -> None:
        self._slots = slots
        self._job = job
        self._failure = ""
        self._actor: Any = None
        self._begin()

    def answer(self) -> SceneAnswer | str | None:
        if self._failure or not ray.wait([self._coming], timeout=0)[0]:
            return self._failure or None
        try:
            answer: SceneAnswer = ray.get(self._coming)
        except ray.exceptions.RayError as error:
            if self._slots.is_alive(self._slot):
                return message_of(error, self._slot.host)
            self._begin()
            return self._failure or None
        return answer

    def kill(self) -> None:
        if self._actor is not None:
            with suppress(ray.exceptions.RayError):
                ray.kill(self._actor)
            self._slots.scenes[self._slot.node] -= 1

    def _begin(self) -> None:
        """On the machine that has the fewest of these; or fail, where there is none any more."""
        machines = self._slots.machines()
        if not machines:
            self._failure = "the cluster has lost its machines"
            return
        self._slot = min(machines, key=lambda slot: self._slots.scenes[slot.node])
        self._slots.scenes[self._slot.node] += 1
        self._actor = self._slots.scene_actor(self._slot)
        self._coming = self._actor.reconstruct.remote(self._job)


def message_of(error: Exception, host: str) -> str:
    """Where it was and what Ray says of it, shortened: Ray is lengthy, and begins with its own ids."""
    lines = [line for line in str(error).splitlines() if not re.match(r"\t\w+: ", line)]
    return f"on {host}: {textwrap.shorten(' '.join(lines[1:] or lines), 240)}"
