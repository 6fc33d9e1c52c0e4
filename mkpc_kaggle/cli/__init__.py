"""The command line: ``mkpc COMMAND``, ``python -m mkpc_kaggle COMMAND``, ``make_submission.py``."""

import argparse
import errno
import os
import sys
import time
import warnings
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from importlib import import_module
from io import TextIOWrapper
from typing import NoReturn

from mkpc_kaggle.version import __version__

COMMANDS = {
    "submit": "a test directory -> submission.csv",
    "match": "two images -> F, counts, a figure",
    "reconstruct": "a folder of images -> cameras, a COLMAP database, models",
    "validate": "a directory with known poses -> mAA and pose AUC of a recipe",
    "score": "submission.csv with known poses -> mAA",
    "recipes": "list recipes; with a name, its units and missing weights",
    "weights": "list, verify and fetch weight files",
    "check": "compare a submission.csv with the competition's format",
    "journal": "how far a run is, from its journal",
    "package": "write the folders to upload to Kaggle: a dataset and a notebook",
    "demo": "render a small test set with known poses",
}
EXIT_BAD_INPUT = 2
EXIT_BROKEN_PIPE = 141  # a shell's status for SIGPIPE, which Windows does not define
EXIT_INTERRUPTED = 128 + 2  # a shell's status for SIGINT


def program(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a command and end the process at once: an orderly exit takes a second or longer."""
    try:  # Ctrl-C during slow imports is not an error
        status = main(arguments)
        from mkpc_kaggle.setup.console import leave
    except KeyboardInterrupt:
        os._exit(EXIT_INTERRUPTED)
    leave(status)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command. Return the exit status.

    0: done; 1: a check failed; 2: bad input; 130, 143: ended by a signal; 141: the reader of the
    output closed the pipe. The time limit counts from the call, before the slow imports.
    """
    started = time.monotonic()
    from mkpc_kaggle.errors import UserError
    from mkpc_kaggle.setup.console import logger

    for stream in (sys.stdout, sys.stderr):
        # Paths and ids may have characters that the terminal cannot encode.
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    # Leaving the stack ends the thread that prints after the messages below.
    with ExitStack() as printing, warnings.catch_warnings():
        # One line each, without the file and line that Python prints.
        warnings.showwarning = lambda message, *_, **__: logger.warning(str(message))
        try:
            given = sys.argv[1:] if arguments is None else list(arguments)
            return _run(given, started, printing)
        except UserError as error:
            logger.error(str(error))
            return EXIT_BAD_INPUT
        except KeyboardInterrupt as error:
            logger.error("interrupted")
            return 128 + int(*error.args) if error.args else EXIT_INTERRUPTED
        except BrokenPipeError:  # the reader closed the pipe, as `head` does
            return EXIT_BROKEN_PIPE
        except OSError as error:
            # A path of the user's. Any other error is a fault of the program: a traceback.
            if error.errno != errno.ENAMETOOLONG:
                raise
            logger.error(f"{error.strerror}: {str(error.filename)[:80]}...")
            return EXIT_BAD_INPUT


def _run(given: Sequence[str], started: float, printing: ExitStack) -> int:
    """Parse the arguments and run their command; without arguments, print the commands."""
    parser = make_parser(given)
    if not given:
        parser.print_help()
        return 0
    parsed = parser.parse_args(given)
    parsed.started = started
    # After parsing: --help and errors in options need no thread that prints.
    printing.enter_context(parsed.printing())
    status = int(parsed.run(parsed) or 0)
    try:
        # A slow reader is waited for, except in a run, whose lines another thread prints.
        if sys.stdout is not None and parsed.printing is nullcontext:
            sys.stdout.flush()
    except BrokenPipeError:
        raise
    except (OSError, ValueError):  # the disk is full, or the stream closed
        pass
    return status


def make_parser(arguments: Sequence[str] = tuple(COMMANDS)) -> argparse.ArgumentParser:
    """Return the parser for these arguments.

    Only the commands that they name are imported: imports take time.
    """
    text = "Two-stage image matching with Matching Key-Points Crop, offline, inside a time budget."
    epilog = "mkpc COMMAND --help has the options of a command."
    parser = argparse.ArgumentParser("mkpc", description=text, epilog=epilog)
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, summary in COMMANDS.items():
        sub = commands.add_parser(
            name, help=summary, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        if name in arguments:
            command = import_module(f"mkpc_kaggle.cli.{name}")
            sub.description = command.HELP
            sub.set_defaults(run=command.run, printing=nullcontext)
            command.add_arguments(sub)
    return parser
