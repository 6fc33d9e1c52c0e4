"""Options shared by several commands, and tables for the terminal."""

import argparse
import json
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import inf
from pathlib import Path
from typing import Any

from mkpc_kaggle.data.competition import Pair, TrainScene, read_train_side
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.session import Session
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.progress import parse_duration
from mkpc_kaggle.recipe import parse_setting, split_mode
from mkpc_kaggle.setup.assembly import Assembly, assemble
from mkpc_kaggle.setup.console import drain, logger, queued
from mkpc_kaggle.signals import Interrupt

RECIPE = """a recipe, or one matcher such as aliked_lightglue (default: auto, every matcher with its weights).
    MODE stage-1 runs its units of stage 1 alone, whole-images all its units without crops"""

MAX_STEP_BACK_S = 60.0  # of the wall clock, between --started-at and the start
WORKER_FORMS = "a number of processes, ray (this machine's cluster, or a new one for this run), ray://HOST:PORT"


def add_matching(parser: argparse.ArgumentParser) -> None:
    """Add the options of matching: recipe, weights, device and settings."""
    add = parser.add_argument
    add(
        "--recipe",
        default="auto",
        metavar="NAME|FILE.toml[:MODE]",
        help=RECIPE,
    )
    add_weights(parser)
    add(
        "--device",
        default="auto",
        help="cpu, cuda, cuda:N, or auto (the default): all GPUs, else the CPU",
    )
    text = """precision of the networks; auto: half precision if the device computes faster with it
        (default: float32)"""
    add(
        "--precision",
        default="float32",
        choices=["float32", "auto", "bfloat16", "float16"],
        help=text,
    )
    text = """change a setting of the recipe, such as matchers.loftr.threshold=0.3; may be
        repeated. docs/recipes.md lists the settings"""
    add("--set", action="append", default=[], metavar="TABLE.KEY=VALUE", help=text)


def recipe_files(*recipes: str) -> list[Path]:
    """Return the files of recipes, which no output may replace; a recipe's name has none."""
    # A folder may have the name of a recipe.
    return [Path(name) for name, _ in map(split_mode, recipes) if name.endswith(".toml")]


def add_weights(parser: argparse.ArgumentParser) -> None:
    """Add ``--weights``."""
    text = "directory of weight files; may be repeated. Also searched: $MKPC_WEIGHTS and /kaggle/input"
    parser.add_argument(
        "--weights", action="append", default=[], type=Path, metavar="DIR", help=text
    )


def add_train_side(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose pairs of ``--train-dir``."""
    add = parser.add_argument
    add("--scenes", default="", metavar="A,B", help="scenes of --train-dir; default: all")
    add(
        "--pairs-per-scene",
        type=int,
        metavar="N",
        help="pairs of each scene, evenly spread; default: all",
    )
    text = "minimum covisibility of pairs of --train-dir; default: 0.1, as in the competition"
    add("--min-covisibility", type=float, default=0.1, help=text)


def train_side_of(arguments: argparse.Namespace) -> tuple[TrainScene, ...]:
    """Return the chosen pairs of ``--train-dir``."""
    most = arguments.pairs_per_scene
    if most is not None and most < 1:
        raise UserError("--pairs-per-scene: give 1 or more")
    names = filter(None, arguments.scenes.split(","))
    least = arguments.min_covisibility
    return read_train_side(
        arguments.train_dir, scenes=names, min_covisibility=least, pairs_per_scene=most
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    text = "write all figures, per pair too: of one run, or a list"
    parser.add_argument("--json", type=Path, metavar="FILE", help=text)


def write_json(arguments: argparse.Namespace, figures: Sequence[Any]) -> None:
    """Write the figures of a run, or a list of those of several runs, to the file of ``--json``."""
    if arguments.json is not None and figures:
        text = json.dumps(figures[0] if len(figures) == 1 else figures, indent=1)
        with writing(f"--json {arguments.json}"):
            arguments.json.write_text(f"{text}\n", encoding="utf-8")


def add_run(parser: argparse.ArgumentParser, time_limit: str | None) -> None:
    """Add the options of the engine; ``time_limit``: the default, ``None`` for no limit."""
    # A run's reader may be slow or hang.
    parser.set_defaults(printing=queued)
    add = parser.add_argument
    text = f"""limit from the start of the program, such as 8h45m, 90m or 60s; the run ends before it, with the
        units that fit (default: {time_limit or "none"})"""
    add("--time-limit", default=time_limit, metavar="TIME", help=text)
    text = (
        "count the limit from this time, in seconds since 1970: time.time(), or $(date +%%s)"
    )
    add("--started-at", type=float, metavar="SECONDS", help=text)
    text = """number of worker processes (default: one per GPU, or one for the CPU); 0: compute in this process.
        ray: use the Ray cluster of this machine, one worker per GPU, or per machine without GPUs; HOST:PORT as
        printed by `ray start --head`"""
    add("--workers", type=parse_workers, metavar="N|ray[://HOST:PORT]", help=text)


def parse_workers(text: str) -> int | str:
    """Parse the value of ``--workers``: return a number, or a cluster's name unchanged.

    Raises :class:`UserError` with the accepted forms if the text has none of them.
    """
    if not re.fullmatch(r"\d{1,3}|ray(://[^/\s]+:\d{1,5})?", text):
        raise UserError(f"--workers: {text!r} is none of: {WORKER_FORMS}")
    return int(text) if text.isdecimal() else text


def settings_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of ``--set`` by dotted key; the last value of a key counts."""
    # A dictionary keeps the last value of a key.
    return dict(map(parse_setting, arguments.set))


def assembly_of(arguments: argparse.Namespace, interrupt: Interrupt, recipe: str) -> Assembly:
    """Return the assembly of a recipe with the command's options."""
    with interrupt.raising():  # computing the digests of large files takes long
        return assemble(
            recipe,
            weights=arguments.weights,
            device=arguments.device,
            precision=arguments.precision,
            scenes=arguments.reconstruct,
            settings=settings_of(arguments),
        )


def budget_of(arguments: argparse.Namespace) -> Budget:
    """Return the budget, which counts from the program's start or from ``--started-at``."""
    started = arguments.started
    if arguments.started_at is not None:
        started = monotonic_of(arguments.started_at)
    limit = arguments.time_limit
    return Budget(started, inf if limit is None else parse_duration(limit))


def monotonic_of(epoch: float) -> float:
    """Return the monotonic clock's time at the wall-clock time ``epoch``, given in seconds since
    1970.

    A run calls this once, at its start, so later jumps of the wall clock do not move the limit. A
    time less than a minute ahead counts as now, because the clock was probably set back. Raises
    :class:`UserError` for a later time.
    """
    ago = time.time() - epoch
    if not -MAX_STEP_BACK_S < ago < inf:
        raise UserError(
            f"--started-at {epoch:g} is not a moment of the past; it is in seconds since 1970 (date +%s)"
        )
    return time.monotonic() - max(0.0, ago)


@contextmanager
def watched_session(
    arguments: argparse.Namespace, work_dir: Path, interrupt: Interrupt
) -> Iterator[Session]:
    """Open a session with these options.

    Its watchdog ends the program in time even if the run hangs.
    """
    with Session(
        work_dir, budget_of(arguments), interrupt, arguments.fresh, workers=arguments.workers
    ).watched() as session:
        yield session
        drain()  # while the watchdog is active: the reader of the output may hang


def finish(session: Session, page: Path | None, pairs: Sequence[Pair]) -> int:
    """Write a run's report to ``page``, if given. Return the exit status.

    It is that of a received signal, else the session's.
    """
    from mkpc_kaggle.reporting.page import report_run

    if page is not None:
        logger.info(report_run(session.work_dir, page, session.must_end(), pairs))
    if session.interrupt.signal:
        return 128 + session.interrupt.signal  # as shells do
    return session.status


def print_table(rows: Sequence[tuple[str, ...]]) -> None:
    """Print rows of equal length in aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        print("  ".join(cells).rstrip())
