"""One run from its parts: journal, worker and engine opened, used and let go of."""

import hashlib
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from mkpc_kaggle.assembly import Assembly
from mkpc_kaggle.competition import Pair
from mkpc_kaggle.run.budget import Budget
from mkpc_kaggle.run.engine import Engine, RunReport
from mkpc_kaggle.run.jobs import Record
from mkpc_kaggle.run.journal import Journal
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
    journal = Journal(session.work_dir, belongs_to, fresh=session.fresh)
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
    finally:
        at_rest = worker.close()
        journal.close()
    return report, at_rest


def digest_of(pairs: Sequence[Pair]) -> str:
    """Tells one test set from another: the keys of its pairs, in order."""
    return hashlib.sha256("\n".join(pair.key for pair in pairs).encode()).hexdigest()


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
