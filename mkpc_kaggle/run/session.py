"""One run from its parts: journal, worker and engine opened, used and let go of."""

import hashlib
import platform
import signal
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from math import isfinite
from pathlib import Path
from types import FrameType

import cv2
import numpy as np

from mkpc_kaggle import __version__
from mkpc_kaggle.assembly import Assembly
from mkpc_kaggle.competition import Pair
from mkpc_kaggle.run.budget import Budget
from mkpc_kaggle.run.engine import Engine, RunReport
from mkpc_kaggle.run.jobs import Record
from mkpc_kaggle.run.journal import About, EventKind, Journal
from mkpc_kaggle.run.worker import InProcessWorker


class Interrupt(threading.Event):
    """Set when the run shall end early; ``signal`` is what asked for it, 0 if nothing did."""

    signal = 0


@dataclass(frozen=True)
class Session:
    """What a run needs besides its pairs and its recipe."""

    work_dir: Path
    budget: Budget
    interrupt: Interrupt
    fresh: bool = False
    progress: bool = True


def run_pairs(
    pairs: Sequence[Pair],
    assembly: Assembly,
    session: Session,
    publish: Callable[[Sequence[Record]], None] = lambda _: None,
) -> tuple[RunReport, bool]:
    """Run the recipe on all pairs; the report, and whether every thread has come to rest.

    Raises :class:`mkpc_kaggle.errors.UserError` before any work where the journal is another run's, or a
    matcher cannot be loaded.
    """
    belongs_to = {"test set": digest_of(pairs), **assembly.fingerprint()}
    about = about_run(assembly, session.budget)
    journal = Journal(session.work_dir, belongs_to, pairs=pairs, about=about, fresh=session.fresh)
    journal.note(EventKind.START, time.monotonic() - session.budget.started, "")
    worker = InProcessWorker(assembly.pipeline)
    try:
        engine = Engine(
            pairs,
            assembly.recipe,
            worker,
            journal,
            session.budget,
            publish=publish,
            interrupt=session.interrupt,
            progress=session.progress,
        )
        report = engine.run()
        journal.note(EventKind.END, report.seconds, report.ending)
    finally:
        at_rest = worker.close()
        journal.close()
    return report, at_rest


def about_run(assembly: Assembly, budget: Budget) -> About:
    """What a report tells of a run besides what its journal is held against."""
    return About(
        assembly.recipe.name,
        str(assembly.placement),
        budget.limit if isfinite(budget.limit) else None,
        tuple(unit.name for unit in assembly.left_out),
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


def digest_of(pairs: Sequence[Pair]) -> str:
    """Tells one test set from another: the ids of its pairs, in order."""
    return hashlib.sha256("\n".join(pair.id for pair in pairs).encode()).hexdigest()


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
