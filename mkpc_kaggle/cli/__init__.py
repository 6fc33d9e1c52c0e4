"""The command line: ``python -m mkpc_kaggle COMMAND`` and ``make_submission.py``."""

import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    import argparse

COMMANDS = ("submit", "match", "validate", "recipes", "weights", "check", "journal", "package", "demo")
EXIT_BAD_INPUT = 2
EXIT_BROKEN_PIPE = 128 + 13  # a shell's status for SIGPIPE, which Windows lacks
EXIT_INTERRUPTED = 128 + 2  # and for SIGINT

_DESCRIPTION = "Two-stage image matching with Matching Key-Points Crop, offline, inside a time budget."


def program(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a command and end the process, without what an interpreter would still do for a second or longer."""
    try:  # imports take a while, and Ctrl-C is no error
        from mkpc_kaggle.engine.budget import process_started
        from mkpc_kaggle.engine.console import leave

        status = main(arguments, started=process_started())
    except KeyboardInterrupt:
        os._exit(EXIT_INTERRUPTED)
    leave(status)


def main(arguments: Sequence[str] | None = None, *, started: float | None = None) -> int:
    """Run a command; the exit status: 0 done, 1 a check failed, 2 bad input, 130 / 143 ended by a signal.

    141: the reader of the output closed the pipe. The time limit counts from ``started``; default: now.
    """
    import errno
    import time
    import warnings
    from io import TextIOWrapper

    from mkpc_kaggle.engine.console import complain, warn
    from mkpc_kaggle.errors import UserError

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # paths and ids may have letters that the terminal lacks
            stream.reconfigure(errors="backslashreplace")
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: warn(str(message))
        try:
            parsed = make_parser().parse_args(arguments)
            parsed.started = time.monotonic() if started is None else started
            return int(parsed.run(parsed))
        except UserError as error:
            complain(str(error))
            return EXIT_BAD_INPUT
        except KeyboardInterrupt:
            complain("interrupted")
            return EXIT_INTERRUPTED
        except BrokenPipeError:  # the reader closed the pipe, as head does
            return EXIT_BROKEN_PIPE
        except OSError as error:
            if error.errno != errno.ENAMETOOLONG:
                raise
            complain(f"{error.strerror}: {str(error.filename)[:80]}...")
            return EXIT_BAD_INPUT


def make_parser() -> "argparse.ArgumentParser":
    """The parser of all commands."""
    import argparse
    from importlib import import_module

    from mkpc_kaggle import __version__

    parser = argparse.ArgumentParser("mkpc_kaggle", description=_DESCRIPTION, epilog="COMMAND --help tells more.")
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        command = import_module(f"mkpc_kaggle.cli.{name}")
        sub = commands.add_parser(
            name,
            help=command.__doc__,
            description=command.HELP,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.add_arguments(sub)
        sub.set_defaults(run=command.run)
    return parser
