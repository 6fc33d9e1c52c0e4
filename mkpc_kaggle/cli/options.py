"""Options that several commands share."""

import argparse
import os
from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

from mkpc_kaggle.engine.budget import Budget, monotonic_of, parse_duration
from mkpc_kaggle.errors import UserError

if TYPE_CHECKING:
    from mkpc_kaggle.engine.cluster import RayCluster
    from mkpc_kaggle.pipeline.assembly import Assembly
    from mkpc_kaggle.recipe import Choice


def add_matching(parser: argparse.ArgumentParser) -> None:
    """What decides how pairs are matched."""
    parser.add_argument(
        "--recipe",
        default="auto",
        metavar="NAME|FILE.toml",
        help="what to run; `recipes` lists the names. auto (the default): the best that the weights allow",
    )
    add_weights(parser)
    parser.add_argument(
        "--licence",
        choices=["any", "permissive"],
        default="any",
        help="permissive: use weights under Apache-2.0, BSD-3-Clause or MIT only; recipe auto then leaves "
        "the others out, units with a fallback take it, any other recipe that has them is refused (default: any)",
    )
    parser.add_argument(
        "--device", default="auto", help="cpu, cuda, cuda:N, or auto (the default): the GPUs if there are any"
    )
    parser.add_argument(
        "--precision",
        default="float32",
        choices=["float32", "auto", "bfloat16", "float16"],
        help="of the networks; auto: half precision where the device is faster in it (default: float32)",
    )


def add_weights(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--weights",
        action="append",
        default=[],
        type=Path,
        metavar="DIR",
        help="where weight files lie; may be repeated. Also searched: $MKPC_WEIGHTS and /kaggle/input",
    )


def add_mode(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--mode",
        choices=["two-stage", "stage-1", "whole-images"],
        default="two-stage",
        help="two-stage (the default): the recipe as written; stage-1: its units of stage 1 alone; whole-images: "
        "all its units on whole images, the naive ensemble of equal inference count",
    )


def add_scenes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--scenes",
        dest="reconstruct",
        action=argparse.BooleanOptionalAction,
        help="reconstruct the pairs of a batch together and take F from the cameras, or not (default: as the "
        "recipe has it; the paper's recipes have not). A pair's F then comes from other pairs, too: read your "
        "competition's rules on that, and compare published stereo scores with --no-scenes",
    )


def add_no_scenes(parser: argparse.ArgumentParser) -> None:
    """The same, for commands whose ``--scenes`` has another meaning."""
    parser.add_argument(
        "--no-scenes",
        dest="reconstruct",
        action="store_const",
        const=False,
        help="F from each pair's own matches alone, whatever the recipe has",
    )


def assembly_of(arguments: argparse.Namespace, choice: "Choice") -> "Assembly":
    """The parts of a run, as the options of :func:`add_matching` say, but for the choice of the recipe."""
    from mkpc_kaggle.pipeline.assembly import assemble
    from mkpc_kaggle.pipeline.availability import Licence

    return assemble(
        choice.recipe,
        weights=arguments.weights,
        device=arguments.device,
        precision=arguments.precision,
        mode=choice.mode,
        licence=Licence(arguments.licence),
        scenes=arguments.reconstruct,
    )


def add_engine(parser: argparse.ArgumentParser) -> None:
    """How the engine works."""
    parser.add_argument(
        "--workers",
        type=workers,
        metavar="N|ray[://HOST:PORT]",
        help="worker processes; 0: none, all work is done in this one (default: one for each GPU, or one for "
        "the CPU with all its threads). ray: on the Ray cluster that this machine belongs to, one worker for each "
        "GPU, or for each machine if it has none; HOST:PORT as `ray start --head` tells it",
    )
    parser.add_argument("--explain", action="store_true", help="say at the end what was planned when, and why")


def workers(text: str) -> "int | RayCluster":
    """A number of worker processes, or the cluster to work on."""
    from mkpc_kaggle.engine.cluster import parse_workers

    try:
        return parse_workers(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def at_least_1(text: str) -> int:
    """A count of something."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of 1 or more")
    return int(text)


def add_time_limit(parser: argparse.ArgumentParser, default: str | None) -> None:
    parser.add_argument(
        "--time-limit",
        default=default,
        metavar="TIME",
        help="such as 8h45m, 90m or 60s, counted from the start of the program; the run ends before it is over, "
        f"and uses the time to run as many units as fit (default: {default or 'none'})",
    )
    parser.add_argument(
        "--started-at",
        type=float,
        metavar="SECONDS",
        help="count the limit from this moment instead, in seconds since 1970: a notebook that started before "
        "gives the time.time() of its first cell, a script $(date +%%s)",
    )


def require_apart(
    files: Mapping[str, Path | None], work_dir: Path | None, inputs: Sequence[Path], weights: Sequence[Path] = ()
) -> None:
    """Refuse outputs that are in each other's way, or would overwrite an input; raises :class:`UserError`.

    ``files`` are what a command writes, by option, beside the journal in ``work_dir``; ``inputs`` and ``weights``
    as for :func:`mkpc_kaggle.data.outputs.require_no_input`.
    """
    from mkpc_kaggle.data.outputs import lies_in, require_no_input, same_file

    given = {option: path for option, path in files.items() if path is not None}
    for option, path in given.items():
        if not path.name or os.path.isdir(path):  # noqa: PTH112  Path raises for a name that is too long
            raise UserError(f"{option} {str(path)!r} is a directory; name a file")
        for other, its_path in given.items():
            if other != option and same_file(path, its_path):
                raise UserError(
                    f"{option} {path} and {other} {its_path} are one file; name another for one of them"
                )
        if work_dir is not None and (
            lies_in(work_dir, path) or (same_file(path.parent, work_dir) and path.name.startswith("journal."))
        ):
            raise UserError(f"{option} {path} and the work directory {work_dir} are in each other's way")
    environment = (Path(part) for part in os.environ.get("MKPC_WEIGHTS", "").split(os.pathsep) if part)
    require_no_input(given, [*inputs, *weights, *environment])
    for place in inputs:
        if work_dir is not None and lies_in(work_dir, place):
            raise UserError(f"--work-dir {work_dir} would be written over the input {place}; name another place")


def budget_of(arguments: argparse.Namespace) -> Budget:
    started = arguments.started if arguments.started_at is None else monotonic_of(arguments.started_at)
    return Budget(started, inf if arguments.time_limit is None else parse_duration(arguments.time_limit))
