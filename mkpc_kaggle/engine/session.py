"""One run from its parts: journal, pool and engine opened, used and let go of."""

import hashlib
import multiprocessing
import os
import platform
import signal
import sqlite3
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from math import isfinite
from pathlib import Path
from types import FrameType, TracebackType
from typing import NoReturn, Self

import cv2
import numpy as np

from mkpc_kaggle import __version__
from mkpc_kaggle.data.competition import Pair, discard_parts
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.costs import Timeouts
from mkpc_kaggle.engine.engine import LISTEN_SECONDS, Engine, RunReport
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.journal_tables import About, EventKind
from mkpc_kaggle.engine.pools.cluster import RayCluster
from mkpc_kaggle.engine.pools.local import LocalWorker
from mkpc_kaggle.engine.pools.pool import Place, Pool
from mkpc_kaggle.engine.pools.process import ProcessWorker
from mkpc_kaggle.engine.records import PairRecord
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.assembly import Assembly

LEAVING_SECONDS = 0.2
"""What the system takes to end a process."""
REPORT_SECONDS = 2.0
"""How long an interrupted program may write its report: enough for the tables."""


class Interrupt(threading.Event):
    """Set when the run has to end early; ``signal`` is what asked for it, 0 if nothing did."""

    signal = 0


@dataclass(frozen=True)
class Session:
    """What a run needs besides its pairs and its recipe.

    ``workers`` is the number of worker processes, or the cluster to work on; 0: none, the work is done in this
    one; ``None``: one a device. ``watchdog`` is told how to write the submission in the end.
    """

    work_dir: Path
    budget: Budget
    interrupt: Interrupt
    fresh: bool = False
    progress: bool = True
    workers: int | RayCluster | None = 0
    watchdog: "Watchdog | None" = None
    timeouts: Timeouts | None = None

    def must_end(self) -> float:
        """When the program must have ended, by the monotonic clock: with its budget, or soon after a signal."""
        if self.interrupt.signal:
            return time.monotonic() + REPORT_SECONDS
        return self.budget.started + self.budget.limit


def run_pairs(
    pairs: Sequence[Pair],
    assembly: Assembly,
    session: Session,
    publish: Callable[[Sequence[PairRecord]], None] = lambda _: None,
) -> tuple[RunReport, bool]:
    """Run the recipe on all pairs; the report, and whether every thread has come to rest.

    Raises :class:`mkpc_kaggle.errors.UserError` before any work where the journal is another run's, or a
    matcher cannot be loaded.
    """
    belongs_to = {"test set": digest_of(pairs), **assembly.fingerprint()}
    about = about_run(assembly, session.budget)
    with Journal(session.work_dir, belongs_to, pairs=pairs, about=about, fresh=session.fresh) as journal:
        journal.note(EventKind.START, session.budget.spent(), "")
        pool = pool_of(assembly, session.workers)
        engine = Engine(
            pairs,
            assembly.recipe,
            pool,
            journal,
            session.budget,
            publish=publish,
            interrupt=session.interrupt,
            progress=session.progress,
            timeouts=session.timeouts or Timeouts(batch=assembly.minibatch),
        )
        if session.watchdog is not None:
            session.watchdog.save = engine.save_what_there_is
        try:
            report = engine.run()
            journal.note(EventKind.END, report.seconds, report.ending)
        finally:
            at_rest = pool.close()
    return report, at_rest


def about_run(assembly: Assembly, budget: Budget) -> About:
    """What a report says of a run, besides what its journal is compared with."""
    return About(
        assembly.recipe.name,
        str(assembly.placement),
        budget.limit if isfinite(budget.limit) else None,
        assembly.left_out,
        versions(),
    )


def versions() -> dict[str, str]:
    """The versions of what the results may depend on, by name."""
    return {
        "mkpc_kaggle": __version__,
        "Python": platform.python_version(),
        "PyTorch": metadata.version("torch"),
        "OpenCV": cv2.__version__,
        "NumPy": np.__version__,
        "SQLite": sqlite3.sqlite_version,
    }


def pool_of(assembly: Assembly, workers: int | RayCluster | None) -> Pool:
    """One process a device, or as many as are asked for, in turn on each device; or none."""
    if isinstance(workers, RayCluster):
        return _ray_pool(assembly, workers)
    if workers == 0:
        return Pool([Place("this process", partial(LocalWorker, assembly.pipeline))], assembly.recipe)
    # On a CPU one process with all threads: two with half of them each do more (recipe light, two cores: the sweep
    # over after 22 s instead of 31), but need twice the memory, and a network's last bits change with its threads.
    devices = assembly.devices
    used = [devices[number % len(devices)] for number in range(workers or len(devices))]
    share = len(used) if devices == ("cpu",) else 1
    places = [
        _process_place(f"{name} {number}", assembly.on(name, used.count(name)), share)
        for number, name in enumerate(used)
    ]
    fallback = None if devices == ("cpu",) else _process_place("CPU", assembly.on_cpu())
    return Pool(places, assembly.recipe, fallback)


def _process_place(name: str, assembly: Assembly, share: int = 1) -> Place:
    return Place(name, partial(ProcessWorker, name, assembly.pipeline, share))


def _ray_pool(assembly: Assembly, cluster: RayCluster) -> Pool:
    """A pool of the cluster's machines; raises :class:`UserError` where Ray is not installed."""
    # Read when Ray is imported: it must not report usage, and not start a cluster after it was shut down.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ENABLE_AUTO_CONNECT", "0")
    try:
        from mkpc_kaggle.engine.pools.ray_pool import RayPool
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise UserError(
            '--workers ray needs Ray, which is not installed: pip install "mkpc-kaggle[ray]"'
        ) from error
    return RayPool(assembly, cluster)


class Watchdog:
    """Leaves the process at the budget's last moment, the submission written, if the program has not ended.

    A thread does it, so that it helps wherever the others are stuck, short of holding the interpreter's lock:
    that only a matcher in the program's own process can do. Worker processes are ended with this one.

    ``save`` writes the submission, or says why it is not the last version; ``status`` is the exit status of a
    program that is left while it tells what it has done.
    """

    def __init__(self, budget: Budget, interrupt: Interrupt) -> None:
        self.save: Callable[[], str] = lambda: (
            "the time was up before a first version of the submission was written"
        )
        self.status = 0
        self._budget = budget
        self._interrupt = interrupt
        self._over = threading.Event()

    def __enter__(self) -> Self:
        if isfinite(self._budget.limit):
            threading.Thread(target=self._watch, name="watchdog", daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()

    def _watch(self) -> None:
        while (left := self._budget.last - self._budget.clock()) > 0:  # it moves while the run learns
            if self._over.wait(min(left, LISTEN_SECONDS)):
                return
        status = 1
        left = self._budget.over - self._budget.clock() - LEAVING_SECONDS
        last_resort = threading.Timer(max(LEAVING_SECONDS, left), leave, [1])
        last_resort.daemon = True
        last_resort.start()  # the disk may hang, or who reads what is printed
        try:
            trouble = self.save()
            status = self.status or int(bool(trouble))
            if trouble:
                os.write(sys.stderr.fileno(), f"error: {trouble}\n".encode())
        finally:
            leave(128 + self._interrupt.signal if self._interrupt.signal else status)


def leave(status: int) -> NoReturn:
    """End the process at once, and its children, one that was stopped (SIGSTOP) among them."""
    discard_parts()
    for child in multiprocessing.active_children():
        child.kill()
    os._exit(status)


def digest_of(pairs: Sequence[Pair]) -> str:
    """Tells one test set from another: the keys of its pairs with the ids of their images, in order."""
    ids = ((pair.key, pair.group, *(name.rpartition(".")[0] for name in pair.names)) for pair in pairs)
    rows = map("\t".join, ids)
    return hashlib.sha256("\n".join(rows).encode()).hexdigest()


@contextmanager
def interruptible() -> Iterator[Interrupt]:
    """SIGTERM and Ctrl-C set the interrupt; a second one acts as if nobody listened."""
    interrupt = Interrupt()
    former = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def note(number: int, _: FrameType | None) -> None:
        interrupt.signal = number
        interrupt.set()
        restore()

    def restore() -> None:
        for number, handler in former.items():
            signal.signal(number, handler)

    for number in former:
        signal.signal(number, note)
    try:
        yield interrupt
    finally:
        restore()
