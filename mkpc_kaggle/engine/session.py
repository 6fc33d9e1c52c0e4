"""A run from its pairs: the first version, the parts of the run, and the end at the time limit.

A run ends in time by four deadlines of :class:`mkpc_kaggle.engine.budget.Budget`. The plan begins no unit after
the first, and the loop stops waiting at the second. The watchdog here writes the submission at the third if the
loop hangs. Then :func:`mkpc_kaggle.setup.console.leave` kills the children and ends the process before the
limit, without waiting for a thread.
"""

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from math import isfinite
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryFile
from types import MappingProxyType
from typing import Self

from mkpc_kaggle.data.competition import Pair, names_of, submission_problem, write_submission
from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.cluster import RaySite
from mkpc_kaggle.engine.frames import Results
from mkpc_kaggle.engine.keys import Keys, read_images, text_digest
from mkpc_kaggle.engine.places import LISTEN_S, LocalSite, Site
from mkpc_kaggle.engine.request import About, Request
from mkpc_kaggle.engine.run import Run
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.recipe import PINHOLES
from mkpc_kaggle.setup.assembly import Assembly
from mkpc_kaggle.setup.console import LOG_NAME, Progress, leave, logged, logger
from mkpc_kaggle.signals import Interrupt

WORKERS_LOG = "workers.log"  # in the work directory, for the output of native libraries
EXIT_S = 0.2  # for the system to end a process
REPORT_S = 2.0  # for an interrupted program's report; enough for the tables


@dataclass
class Session:
    """The environment of a run: everything besides its pairs and its recipe.

    ``workers`` is the number of worker processes, or the name of a Ray cluster (see
    :func:`mkpc_kaggle.engine.cluster.join`). 0 means this process; ``None`` means a process
    for each device.
    ``save`` writes the submission. It returns an empty string, or why the file is not the last version. ``status``
    is the exit status so far; the watchdog uses it if it ends the program during the final report.
    """

    work_dir: Path
    budget: Budget
    interrupt: Interrupt
    fresh: bool = False
    progress: bool = True
    workers: int | str | None = 0
    save: Callable[[], str] = lambda: (
        "the time limit passed before the first results were written"
    )
    status: int = 0

    def must_end(self) -> float:
        """Return the deadline of the report on the monotonic clock, when the watchdog ends the
        process.
        """
        return (
            time.monotonic() + REPORT_S if self.interrupt.signal else self.budget.final_write
        )

    @contextmanager
    def watched(self) -> Iterator[Self]:
        """Run a watchdog: before the limit, it writes the submission and ends a program that has
        not ended yet.

        The watchdog is a thread, so it works even if other threads hang, unless one of them holds
        the GIL. Only a matcher in the program's own process can hold it. Worker processes end with
        the program.
        """
        over = threading.Event()
        if isfinite(self.budget.time_limit):
            threading.Thread(target=self._watch, args=[over], daemon=True).start()
        try:
            yield self
        finally:
            over.set()

    def _watch(self, over: threading.Event) -> None:
        budget = self.budget
        # The deadline moves as the run measures costs
        while (left := budget.final_write - budget.clock()) > 0:
            if over.wait(min(left, LISTEN_S)):
                return
        trouble = "the time limit passed before the last results were written"

        def write() -> None:
            nonlocal trouble
            trouble = self.save()

        writer = threading.Thread(target=write, daemon=True)
        writer.start()  # the disk may hang
        writer.join(max(EXIT_S, budget.limit - budget.clock() - EXIT_S))
        # Not exit(): its handlers wait for threads, and one of them hangs.
        if trouble:  # in a thread, since run.log may lie on the disk that hangs
            line = threading.Thread(target=logger.error, args=[trouble], daemon=True)
            line.start()
            line.join(EXIT_S / 2)
        status = self.status or int(bool(trouble))
        leave(128 + self.interrupt.signal if self.interrupt.signal else status, EXIT_S / 4)


def first_version(pairs: Sequence[Pair], output: Path, work_dir: Path) -> None:
    """Write fallback rows before using weights, devices or images, which may hang.

    A complete file of an earlier run stays until the loop begins. The work directory gets a copy, since this run
    may have fewer results.
    Raises :class:`mkpc_kaggle.errors.UserError` if ``output`` cannot be written.
    """
    if output.is_char_device() or output.is_block_device():
        raise UserError(f"--output {output} is a device; name a file")
    ids = [pair.id for pair in pairs]
    with writing(f"--output {output}"):
        output.parent.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=output.parent).close()  # before hours of work, not after them
        if not output.is_file() or submission_problem(output, ids):
            write_submission(output, dict.fromkeys(ids, FALLBACK_FUNDAMENTAL))
            return
    # By content: a run that begins often keeps each version once. A full disk costs the copy, not the run.
    text = output.read_text()
    with suppress(OSError):
        work_dir.mkdir(parents=True, exist_ok=True)
        with replacing(work_dir / f"earlier-{text_digest([text])}.csv") as copy:
            copy.write(text)


def submit(
    pairs: Sequence[Pair],
    assembly: Assembly,
    session: Session,
    output: Path,
    root: str = "",
) -> Results:
    """Match all pairs. ``output`` always has a row for each pair, with the fallback F if necessary."""
    ids = [pair.id for pair in pairs]

    def publish(state: State) -> None:
        write_submission(output, dict(zip(ids, state.written[1], strict=True)))

    return run_pairs(pairs, assembly, session, root, publish=publish)


def run_pairs(
    pairs: Sequence[Pair],
    assembly: Assembly,
    session: Session,
    root: str = "",
    *,
    scenes_dir: Path | None = None,
    files: Mapping[str, Sequence[str]] = MappingProxyType({}),
    publish: Callable[[State], None] = lambda _: None,
) -> Results:
    """Run the recipe on all pairs. In the store, an image's name is its path below ``root``.

    ``scenes_dir`` and ``publish`` are as in :class:`mkpc_kaggle.engine.request.Request`, ``files`` as in
    :class:`mkpc_kaggle.engine.request.About`. Raises :class:`mkpc_kaggle.errors.UserError` if the store cannot be
    used or no worker can start, and for F from cameras with distortion.
    """
    scene = assembly.recipe.scene
    if scenes_dir is None and scene is not None and scene.camera_model not in PINHOLES:
        raise UserError(
            f"[scene] has cameras with distortion ({scene.camera_model}), and F ignores it: "
            "use PINHOLE or SIMPLE_PINHOLE here; `mkpc reconstruct` takes all models"
        )
    budget = session.budget
    work_dir = session.work_dir
    about = About(
        {**assembly.recipe.table(), "name": assembly.recipe.name},
        str(assembly.placement),
        assembly.left_out,
        assembly.versions,
        dict(files),
    )
    keys = Keys.of(assembly)
    request = Request(
        pairs, assembly.recipe, keys, root, assembly.cameras, scenes_dir, about, publish
    )
    with Store.open(work_dir, fresh=session.fresh) as store:
        if session.fresh and scenes_dir is not None:
            rmtree(scenes_dir, ignore_errors=True)
        # The workers' log is that of this run.
        with suppress(OSError):
            (work_dir / WORKERS_LOG).unlink(missing_ok=True)
        images: dict[str, Path] = {}
        for pair in pairs:
            images |= zip(names_of(pair, root), pair.images, strict=True)
        progress = Progress(budget.left, is_shown=session.progress)
        is_over = partial(budget.is_over, session.interrupt)
        state = State(request, read_images(store, images, is_over, progress))
        state.restore(store)
        site = _site(pairs, assembly, session)
        run = Run(state, site, store, budget, session.interrupt, progress)
        session.save = run.publication.save
        with logged(work_dir / LOG_NAME):
            return run.run()


def _site(pairs: Sequence[Pair], assembly: Assembly, session: Session) -> Site:
    clock = session.budget.clock
    workers = session.workers
    log = session.work_dir / WORKERS_LOG
    if isinstance(workers, str):
        # The folders of the images must exist on every machine.
        folders = dict.fromkeys(path.parent for pair in pairs for path in pair.images)
        return RaySite(assembly, workers, clock, folders, log)
    return LocalSite(assembly, workers, clock, log)
