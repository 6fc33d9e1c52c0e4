"""How a process ended, in words."""

import signal
from multiprocessing.context import SpawnProcess


def how_it_ended(process: SpawnProcess) -> str:
    """The signal that ended a process, or its exit status; for messages."""
    code = process.exitcode
    return f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit status {code}"
