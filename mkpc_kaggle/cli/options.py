"""Options that several commands share, and tables on the screen."""

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import inf
from pathlib import Path

from mkpc_kaggle.engine.budget import Budget, monotonic_of, parse_duration
from mkpc_kaggle.engine.cluster import parse_workers
from mkpc_kaggle.engine.console import say
from mkpc_kaggle.engine.engine import RunReport
from mkpc_kaggle.engine.session import Interrupt, Session, Watchdog
from mkpc_kaggle.engine.streams import drain, unblocked
from mkpc_kaggle.pipeline.assembly import Assembly, assemble
from mkpc_kaggle.pipeline.availability import Licence
from mkpc_kaggle.recipe import Mode


def add_matching(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    text = "default: auto, the best that the weights allow"
    add("--recipe", default="auto", metavar="NAME|FILE.toml", help=text)
    add_weights(parser)
    text = """permissive: only weights under Apache-2.0, BSD-3-Clause or MIT. Recipe auto leaves the others out,
        units with a fallback take it, any other recipe that has them is refused (default: any)"""
    add("--licence", choices=list(map(str, Licence)), default="any", help=text)
    add("--device", default="auto", help="cpu, cuda, cuda:N, or auto (the default): the GPUs if there are any")
    text = "of the networks; auto: half precision where the device is faster in it (default: float32)"
    add("--precision", default="float32", choices=["float32", "auto", "bfloat16", "float16"], help=text)


def add_weights(parser: argparse.ArgumentParser) -> None:
    text = "where weight files lie; may be repeated. Also searched: $MKPC_WEIGHTS and /kaggle/input"
    parser.add_argument("--weights", action="append", default=[], type=Path, metavar="DIR", help=text)


def add_run(parser: argparse.ArgumentParser, time_limit: str | None) -> None:
    parser.set_defaults(printing=unblocked)
    add = parser.add_argument
    text = """two-stage (the default): the recipe as written; stage-1: its units of stage 1 alone; whole-images:
        all its units on whole images, the naive ensemble of equal inference count"""
    add("--mode", choices=list(map(str, Mode)), default="two-stage", help=text)
    text = f"""such as 8h45m, 90m or 60s, from the start of the program; the run ends before it is over, with as
        many units as fit (default: {time_limit or "none"})"""
    add("--time-limit", default=time_limit, metavar="TIME", help=text)
    text = "count the limit from this moment instead, in seconds since 1970: time.time(), or $(date +%%s)"
    add("--started-at", type=float, metavar="SECONDS", help=text)
    text = """worker processes (default: one for each GPU, or one for the CPU); 0: none, this process does all.
        ray: on the Ray cluster that this machine belongs to, one worker for each GPU, or for each machine if it
        has none; HOST:PORT as `ray start --head` tells it"""
    add("--workers", type=parse_workers, metavar="N|ray[://HOST:PORT]", help=text)
    add("--explain", action="store_true", help="say at the end what was planned when, and why")


def assembly_of(arguments: argparse.Namespace, recipe: str, mode: str, interrupt: Interrupt) -> Assembly:
    given = {name: getattr(arguments, name) for name in ("weights", "device", "precision")}
    licence, scenes = Licence(arguments.licence), arguments.reconstruct
    with interrupt.raising():  # digests of large files
        return assemble(recipe, **given, mode=Mode(mode), licence=licence, scenes=scenes)


def budget_of(arguments: argparse.Namespace) -> Budget:
    started = arguments.started if arguments.started_at is None else monotonic_of(arguments.started_at)
    return Budget(started, inf if arguments.time_limit is None else parse_duration(arguments.time_limit))


@contextmanager
def watched_session(
    arguments: argparse.Namespace, work_dir: Path, interrupt: Interrupt
) -> Iterator[tuple[Session, Watchdog]]:
    """A session as the options say, and the watchdog that ends the program in time whatever happens."""
    budget, fresh, workers = budget_of(arguments), arguments.fresh, arguments.workers
    with Watchdog(budget, interrupt) as watchdog:
        yield Session(work_dir, budget, interrupt, fresh, workers=workers, watchdog=watchdog), watchdog
        drain()  # under the watchdog's eyes: who reads it may hang


def say_start(what: str, assembly: Assembly, work_dir: Path) -> None:
    """Say what is matched by what, and which matchers are left out."""
    from mkpc_kaggle.reporting.summary import left_out_line  # pandas takes a while

    header = f"{what}, recipe {assembly.recipe.name}, {assembly.placement}, journal in {work_dir}"
    say("\n".join(filter(None, [header, left_out_line(assembly.left_out)])))


def plan_lines(arguments: argparse.Namespace, report: RunReport) -> list[str]:
    """What was planned when, and why, if ``--explain`` asks for it."""
    return ["plan:", *map(str, report.explanations)] if arguments.explain else []


def print_table(rows: Sequence[tuple[str, ...]]) -> None:
    """Print rows of equal length, each column as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
