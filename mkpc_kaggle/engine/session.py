"""A run from its parts: journal, site, engine, signals, and the end at the limit."""

import platform
import shutil
import signal
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib import metadata
from math import isfinite
from pathlib import Path
from tempfile import TemporaryFile
from types import FrameType
from typing import Any, Self

import cv2

from mkpc_kaggle.data.competition import Pair, submission_problems, write_submission
from mkpc_kaggle.data.outputs import remove_unfinished, replacing
from mkpc_kaggle.engine import console
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.cluster import RaySite
from mkpc_kaggle.engine.engine import Engine
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.journal_reader import About, Event, EventKind
from mkpc_kaggle.engine.places import LISTEN_S, LocalSite
from mkpc_kaggle.engine.request import Request, RunReport, Standing
from mkpc_kaggle.engine.settings import Settings
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.version import __version__

EXIT_S = 0.2  # that the system takes to end a process
REPORT_S = 2.0  # that an interrupted program may take for its report: enough for the tables


class Interrupt(threading.Event):
    """Set when the run must end early; ``signal`` is what asked for it, 0 if nothing did."""

    signal = 0
    raises = False

    @contextmanager
    def raising(self) -> Iterator[None]:
        """Answer a signal with ``KeyboardInterrupt`` of its number, for work that does not check the event."""
        self.raises = True
        try:
            yield
        finally:
            self.raises = False


@contextmanager
def interruptible() -> Iterator[Interrupt]:
    """Let SIGTERM and Ctrl-C set the interrupt. A second signal has its default effect."""
    interrupt = Interrupt()
    with ExitStack() as restored:

        def note(number: int, _: FrameType | None) -> None:
            restored.close()
            interrupt.signal = number
            interrupt.set()
            if interrupt.raises:
                raise KeyboardInterrupt(number)

        for number in (signal.SIGINT, signal.SIGTERM):
            restored.callback(signal.signal, number, signal.getsignal(number))
            signal.signal(number, note)
        yield interrupt


@dataclass
class Session:
    """The environment of a run: everything besides its pairs and its recipe.

    ``workers`` is the number of worker processes, or the Ray cluster to work on (see
    :func:`mkpc_kaggle.engine.cluster.join`); 0: the work is done in this process; ``None``: a process for each
    device. ``save`` writes the submission, or returns why the file is not the last version. ``status`` is the exit
    status so far, also if the watchdog ends the program during its final report.
    """

    work_dir: Path
    budget: Budget
    interrupt: Interrupt
    fresh: bool = False
    progress: bool = True
    workers: int | str | None = 0
    save: Callable[[], str] = lambda: "the time limit passed before the first results were written"
    status: int = 0

    def must_end(self) -> float:
        """Return when the report must be written, by the monotonic clock: then the watchdog ends the process."""
        return time.monotonic() + REPORT_S if self.interrupt.signal else self.budget.final_write

    @contextmanager
    def watched(self) -> Iterator[Self]:
        """Write the submission and end the process before the limit, if the program has not ended by itself.

        The watchdog is a thread, so it works wherever other threads hang, unless one holds the GIL. Only a matcher
        in the program's own process can do that. Worker processes end with the program.
        """
        over = threading.Event()
        if isfinite(self.budget.time_limit):
            threading.Thread(target=self._watch, args=(over,), name="watchdog", daemon=True).start()
        try:
            yield self
        finally:
            over.set()

    def _watch(self, over: threading.Event) -> None:
        budget = self.budget
        while (left := budget.final_write - budget.clock()) > 0:  # it moves while the run learns
            if over.wait(min(left, LISTEN_S)):
                return
        trouble = "the time limit passed before the last results were written"

        def write() -> None:
            nonlocal trouble
            trouble = self.save()
            with suppress(OSError):
                remove_unfinished()  # a report, say

        writer = threading.Thread(target=write, name="final write", daemon=True)
        writer.start()  # the disk may hang
        writer.join(max(EXIT_S, budget.limit - budget.clock() - EXIT_S))
        if trouble:
            console.complain(trouble)
        status = self.status or int(bool(trouble))
        console.leave(128 + self.interrupt.signal if self.interrupt.signal else status, EXIT_S / 4)


def submit(pairs: Sequence[Pair], assembly: Assembly, session: Session, output: Path, root: str = "") -> RunReport:
    """Match all pairs. ``output`` always has a row for each pair, the fallback if necessary."""

    def publish(standing: Standing) -> None:
        ids = (pair.id for pair in pairs)
        write_submission(output, dict(zip(ids, standing.fundamentals, strict=True)))

    return run_pairs(pairs, assembly, session, root, publish=publish)


@contextmanager
def first_version(pairs: Sequence[Pair], output: Path) -> Iterator[None]:
    """Write fallback rows, unless the file has them, before weights, devices and images: any of those may hang.

    A run that is refused before it has written its own version leaves the former file, or none. Raises
    :class:`mkpc_kaggle.errors.UserError` where ``output`` cannot be written.
    """
    if output.is_char_device() or output.is_block_device():
        raise UserError(f"--output {output} is a device; name a file")
    ours, former, ids = None, None, [pair.id for pair in pairs]
    with ExitStack() as closed:
        with writing(f"--output {output}"):
            output.parent.mkdir(parents=True, exist_ok=True)
            TemporaryFile(dir=output.parent).close()
            if not output.exists() or (output.is_file() and submission_problems(output, ids)):
                if output.is_file():
                    former = closed.enter_context(output.open("rb"))  # it outlives its name
                write_submission(output, dict.fromkeys(ids, FALLBACK_FUNDAMENTAL))
                ours = _identity(output)
        try:
            yield
        except UserError:
            with suppress(OSError):  # somebody else has removed it
                if ours == _identity(output):
                    output.unlink()
                    if former is not None:
                        with replacing(output) as stream:
                            shutil.copyfileobj(former, stream.buffer)
            raise


def _identity(path: Path) -> tuple[int, int]:
    """Return an identity of a file's version: a later file may reuse the inode number of a deleted one."""
    status = path.stat()
    return status.st_ino, status.st_mtime_ns


def run_pairs(
    pairs: Sequence[Pair], assembly: Assembly, session: Session, root: str = "", **more: Any
) -> RunReport:
    """Run the recipe on all pairs. The journal knows their images by their names below ``root``.

    ``more`` are other fields of the request. Raises :class:`mkpc_kaggle.errors.UserError` if the journal cannot be
    used or a matcher cannot be loaded.
    """
    folders = dict.fromkeys(path.parent for pair in pairs for path in pair.images)
    with opened_engine(assembly, session, folders) as engine:
        engine.ask(request_of(pairs, assembly, session, root, **more))
        return engine.report()


def request_of(
    pairs: Sequence[Pair], assembly: Assembly, session: Session, root: str = "", **more: Any
) -> Request:
    """Return a request for these pairs; ``more`` are its other fields."""
    budget, recipe = session.budget, assembly.recipe
    limit = budget.time_limit if isfinite(budget.time_limit) else None
    table = {**recipe.table(), "name": recipe.name}
    versions = {  # software that the results may depend on
        "mkpc_kaggle": __version__,
        "Python": platform.python_version(),
        "PyTorch": metadata.version("torch"),
        "OpenCV": cv2.__version__,
        "NumPy": metadata.version("numpy"),
        "SQLite": sqlite3.sqlite_version,
    }
    about = About(table, str(assembly.placement), limit, assembly.left_out, versions)
    return Request(pairs, recipe, Settings.of(assembly), root, about=about, **more)


@contextmanager
def opened_engine(assembly: Assembly, session: Session, folders: Iterable[Path] = ()) -> Iterator[Engine]:
    """An engine with its journal. Its workers end, and the last results are published, when it is left.

    ``folders`` hold the images, on every machine.
    """
    budget, workers = session.budget, session.workers
    with Journal(session.work_dir, fresh=session.fresh) as journal:
        journal.note(Event(EventKind.START, budget.spent(), ""))
        engine = Engine(
            request_of((), assembly, session),
            RaySite(assembly, workers, budget.clock, folders)
            if isinstance(workers, str)
            else LocalSite(assembly, workers, budget.clock),
            journal,
            budget,
            interrupt=session.interrupt,
            progress=session.progress,
            minibatch=assembly.minibatch,
        )
        session.save = engine.save_results
        with engine:
            yield engine
        journal.note(Event(EventKind.END, budget.spent(), engine.ending))
