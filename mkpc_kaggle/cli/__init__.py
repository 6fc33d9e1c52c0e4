"""The command line: ``python -m mkpc_kaggle COMMAND`` and ``make_submission.py``."""

import argparse
import errno
import os
import shutil
import sys
import time
import warnings
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext, suppress
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path
from typing import NoReturn

from mkpc_kaggle.version import __version__

COMMANDS = {
    "submit": "a test directory -> submission.csv",
    "match": "two images -> F, counts, a figure",
    "reconstruct": "a folder of images -> cameras, a COLMAP database, models",
    "validate": "a directory with known poses -> mAA and pose AUC of a recipe",
    "recipes": "the recipes, their units, and the weights that each lacks",
    "weights": "the weight files: which are there, are they whole, fetch them",
    "check": "is this submission.csv what the competition takes?",
    "journal": "what a run did: overview, tables for pandas, report.html",
    "package": "the folders that you upload to Kaggle: a dataset and a notebook",
    "demo": "render a small test set with known poses",
}
EXIT_BAD_INPUT = 2
EXIT_BROKEN_PIPE = 128 + 13  # a shell's status for SIGPIPE, which Windows lacks
EXIT_INTERRUPTED = 128 + 2  # and for SIGINT


def program(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a command and end the process, without what an interpreter would still do for a second or longer."""
    try:  # imports take a while, and Ctrl-C is no error
        from mkpc_kaggle.engine.budget import process_started
        from mkpc_kaggle.engine.console import leave

        former = os.environ.get("MPLCONFIGDIR")
        status = main(arguments, started=process_started())
        if (made := os.environ.get("MPLCONFIGDIR")) != former:  # by matplotlib, where it cannot write below HOME
            shutil.rmtree(str(made), ignore_errors=True)  # which it would do after this program has left
    except KeyboardInterrupt:
        os._exit(EXIT_INTERRUPTED)
    leave(status)


def main(arguments: Sequence[str] | None = None, *, started: float | None = None) -> int:
    """Run a command; the exit status: 0 done, 1 a check failed, 2 bad input, 130 / 143 ended by a signal.

    141: the reader of the output closed the pipe. The time limit counts from ``started``; default: now.
    """
    from mkpc_kaggle.engine.console import complain, warn
    from mkpc_kaggle.errors import UserError

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # paths and ids may have letters that the terminal lacks
            stream.reconfigure(errors="backslashreplace")
    with ExitStack() as printing, warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: warn(str(message))
        try:
            given = sys.argv[1:] if arguments is None else list(arguments)
            parsed = make_parser(given).parse_args(given)
            require_directory()
            parsed.started = time.monotonic() if started is None else started
            printing.enter_context(parsed.printing())
            status = int(parsed.run(parsed))
            with suppress(OSError, ValueError):  # full, or closed
                if sys.stdout is not None:
                    sys.stdout.flush()  # a reader may take its time, except in a run: there this does not wait
            return status
        except UserError as error:
            complain(str(error))
            return EXIT_BAD_INPUT
        except KeyboardInterrupt as error:
            complain("interrupted")
            return 128 + int(*error.args) if error.args else EXIT_INTERRUPTED
        except BrokenPipeError:  # the reader closed the pipe, as head does
            return EXIT_BROKEN_PIPE
        except OSError as error:
            if error.errno != errno.ENAMETOOLONG:
                raise
            complain(f"{error.strerror}: {str(error.filename)[:80]}...")
            return EXIT_BAD_INPUT


def require_directory() -> None:
    """Raise :class:`UserError` where the current directory has been removed: no path means anything there."""
    from mkpc_kaggle.errors import UserError

    try:
        Path.cwd()
    except OSError as error:
        raise UserError(f"the current directory is gone ({error.strerror}); change to another") from error


def make_parser(arguments: Sequence[str] = tuple(COMMANDS)) -> argparse.ArgumentParser:
    """The parser of these arguments; only the commands among them are imported, since imports take time."""
    text = "Two-stage image matching with Matching Key-Points Crop, offline, inside a time budget."
    parser = argparse.ArgumentParser("mkpc_kaggle", description=text, epilog="COMMAND --help tells more.")
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, summary in COMMANDS.items():
        sub = commands.add_parser(name, help=summary, formatter_class=argparse.RawDescriptionHelpFormatter)
        if name in arguments:
            command = import_module(f"mkpc_kaggle.cli.{name}")
            sub.description = command.HELP
            sub.set_defaults(run=command.run, printing=nullcontext)
            command.add_arguments(sub)
    return parser
