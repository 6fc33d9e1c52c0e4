"""The command line: ``python -m mkpc_kaggle COMMAND`` and ``make_submission.py``."""

import argparse
import errno
import os
import signal
import sys
import time
import warnings
from collections.abc import Sequence
from importlib import import_module
from io import TextIOWrapper
from typing import TextIO

from mkpc_kaggle import __version__
from mkpc_kaggle.errors import UserError

COMMANDS = ("submit", "match", "validate", "recipes", "weights", "check", "journal", "package", "demo")
EXIT_BAD_INPUT = 2
EXIT_BROKEN_PIPE = 128 + 13  # a shell's status for SIGPIPE, which Windows lacks
EXIT_INTERRUPTED = 128 + signal.SIGINT

_DESCRIPTION = "Two-stage image matching with Matching Key-Points Crop, offline, inside a time budget."


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; the exit status: 0 done, 1 a check failed, 2 bad input, 130 / 143 ended by a signal.

    141: the reader of the output closed the pipe.
    """
    started = time.monotonic()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # paths and ids may be of letters that the terminal has not
            stream.reconfigure(errors="backslashreplace")
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        try:
            parsed = make_parser().parse_args(arguments)
            parsed.started = started
            status = int(parsed.run(parsed))
            sys.stdout.flush()
            return status
        except UserError as error:
            print(f"error: {error}", file=sys.stderr)
            return EXIT_BAD_INPUT
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return EXIT_INTERRUPTED
        except BrokenPipeError:
            # The reader closed the pipe, as head does. Without this Python would print a second error at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return EXIT_BROKEN_PIPE
        except OSError as error:
            if error.errno != errno.ENAMETOOLONG:
                raise
            print(f"error: {error.strerror}: {str(error.filename)[:80]}...", file=sys.stderr)
            return EXIT_BAD_INPUT


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
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


def finish(status: int, *, at_rest: bool) -> int:
    """Return ``status``, or exit at once if a thread cannot be stopped: all results are on disk."""
    if not at_rest:
        from mkpc_kaggle.engine.session import leave

        sys.stdout.flush()
        sys.stderr.flush()
        leave(status)
    return status


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Prints the message without the line of code that it came from."""
    print(f"warning: {message}", file=sys.stderr)
