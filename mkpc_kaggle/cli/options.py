"""Options shared by several commands, and tables for the terminal."""

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import inf
from pathlib import Path
from typing import Any

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import Budget, monotonic_of, parse_duration
from mkpc_kaggle.engine.cluster import parse_workers
from mkpc_kaggle.engine.console import Progress, drain, say, unblocked
from mkpc_kaggle.engine.request import RunReport
from mkpc_kaggle.engine.session import Interrupt, Session
from mkpc_kaggle.pipeline.assembly import Assembly, assemble
from mkpc_kaggle.pipeline.availability import Licence
from mkpc_kaggle.recipe import Mode, parse_setting
from mkpc_kaggle.reporting.summary import left_out_line


def add_matching(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--recipe",
        default="auto",
        metavar="NAME|FILE.toml",
        help="default: auto, every matcher with its weights",
    )
    add_weights(parser)
    text = """permissive: only weights under Apache-2.0, BSD-3-Clause or MIT. Recipe auto omits other weights, and
        units run their fallback; any other recipe that needs them is refused (default: any)"""
    add("--licence", choices=list(map(str, Licence)), default="any", help=text)
    add(
        "--device",
        default="auto",
        help="cpu, cuda, cuda:N, or auto (the default): all GPUs, else the CPU",
    )
    text = "of the networks; auto: half precision if the device computes faster with it (default: float32)"
    add(
        "--precision",
        default="float32",
        choices=["float32", "auto", "bfloat16", "float16"],
        help=text,
    )
    text = """another value of a recipe's setting, such as matchers.loftr.threshold=0.3; may be
        repeated. docs/recipes.md lists the settings"""
    add("--set", action="append", default=[], metavar="TABLE.KEY=VALUE", help=text)


def add_weights(parser: argparse.ArgumentParser) -> None:
    text = (
        "directory of weight files; may be repeated. Also searched: $MKPC_WEIGHTS and /kaggle/input"
    )
    parser.add_argument(
        "--weights", action="append", default=[], type=Path, metavar="DIR", help=text
    )


def add_run(parser: argparse.ArgumentParser, time_limit: str | None) -> None:
    parser.set_defaults(printing=unblocked)
    add = parser.add_argument
    text = """two-stage (the default): the recipe as written; stage-1: only its units of stage 1; whole-images:
        all its units on whole images, the naive ensemble of equal inference count"""
    add("--mode", choices=list(map(str, Mode)), default="two-stage", help=text)
    text = f"""such as 8h45m, 90m or 60s, from the start of the program; the run ends before the limit, with the
        units that fit (default: {time_limit or "none"})"""
    add("--time-limit", default=time_limit, metavar="TIME", help=text)
    text = "count the limit from this time, in seconds since 1970: time.time(), or $(date +%%s)"
    add("--started-at", type=float, metavar="SECONDS", help=text)
    text = """number of worker processes (default: one per GPU, or one for the CPU); 0: compute in this process.
        ray: use the Ray cluster of this machine, one worker per GPU, or per machine without GPUs; HOST:PORT as
        printed by `ray start --head`"""
    add("--workers", type=parse_workers, metavar="N|ray[://HOST:PORT]", help=text)
    add("--explain", action="store_true", help="print the plan at the end: what, when and why")


def settings_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of ``--set`` by dotted key; the last value of a key counts."""
    return dict(map(parse_setting, arguments.set))


def assembly_of(
    arguments: argparse.Namespace, recipe: str, mode: str, interrupt: Interrupt
) -> Assembly:
    with interrupt.raising():  # computing the digests of large files takes long
        return assemble(
            recipe,
            weights=arguments.weights,
            device=arguments.device,
            precision=arguments.precision,
            mode=Mode(mode),
            licence=Licence(arguments.licence),
            scenes=arguments.reconstruct,
            settings=settings_of(arguments),
        )


def budget_of(arguments: argparse.Namespace) -> Budget:
    started = (
        arguments.started if arguments.started_at is None else monotonic_of(arguments.started_at)
    )
    return Budget(
        started, inf if arguments.time_limit is None else parse_duration(arguments.time_limit)
    )


@contextmanager
def watched_session(
    arguments: argparse.Namespace, work_dir: Path, interrupt: Interrupt
) -> Iterator[Session]:
    """Open a session with these options, whose watchdog ends the program in time even if the run
    hangs.
    """
    budget, fresh, workers = budget_of(arguments), arguments.fresh, arguments.workers
    with Session(work_dir, budget, interrupt, fresh, workers=workers).watched() as session:
        yield session
        drain()  # while the watchdog is active: the reader of the output may hang


def say_start(what: str, assembly: Assembly, work_dir: Path) -> None:
    """Print the input, the recipe and the omitted matchers."""
    header = f"{what}, recipe {assembly.recipe.name}, {assembly.placement}, journal in {work_dir}"
    say("\n".join(filter(None, [header, left_out_line(assembly.recipe, assembly.left_out)])))


def finish(session: Session, page: Path | None, pairs: Sequence[Pair]) -> int:
    """Write a run's report to ``page``, if given. Return a received signal's exit status, else the
    session's.
    """
    from mkpc_kaggle.reporting.report import report_run

    if page is not None:
        progress = Progress(session.budget, sys.stderr)
        say(report_run(session.work_dir, page, session.must_end(), pairs, progress))
    return 128 + session.interrupt.signal if session.interrupt.signal else session.status


def plan_lines(arguments: argparse.Namespace, report: RunReport) -> list[str]:
    """Return the plan (what, when and why) as lines with ``--explain``, and no lines without it."""
    return ["plan:", *map(str, report.explanations)] if arguments.explain else []


def print_table(rows: Sequence[tuple[str, ...]]) -> None:
    """Print rows of equal length in aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print(
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        )
