"""Runs that are ended in every way."""

import os
import signal
import subprocess
import time
from collections.abc import Iterator

from attack import Act, Case
from room import SUBMIT, options

WITHOUT_LIMIT = SUBMIT.replace(" --time-limit 5m", "").replace(" --workers 0", "")
# Time limits that end the run early, and limits that do not
SHORT = ("1s", "0.001s", "3s")
LONG = ("99999999999h", "' 60s '")
SOON = (0.6, 1.5, 3.0, 6.0)  # Python itself takes 0.1 s to start, more on a busy machine
ENDS = {"SIGINT": 130, "SIGTERM": 143}
STATUSES = {name: (0, status, -status + 128) for name, status in ENDS.items()}
# Signals that the program does not handle: the kernel ends it, and the next run must resume.
CRUEL = {
    "SIGKILL": -9,
    "SIGHUP": -1,
    "SIGQUIT": -3,
    "SIGUSR1": -10,
    "SIGXCPU": -24,
    "SIGSEGV": -11,
}
AGAIN = SUBMIT.replace("quick.toml", "classical")
WORKING = f"{WITHOUT_LIMIT.replace('quick.toml', 'classical')} --workers"


def sends(name: str, *after: float, group: bool = False) -> Act:
    """Send the signal after these seconds, and again after each further number of seconds."""

    def act(process: "subprocess.Popen[bytes]") -> None:
        for seconds in after:
            time.sleep(seconds)
            if process.poll() is None:
                send = os.killpg if group else os.kill
                send(process.pid, signal.Signals[name])

    return act


def signals() -> Iterator[Case]:
    for name in ENDS:
        acts = {f"after {after} s": sends(name, after) for after in SOON}
        acts |= {
            f"to all after {after} s": sends(name, after, group=True) for after in SOON[::2]
        }
        acts["twice"] = sends(name, 3.0, 0.2)
        for when, act in acts.items():
            yield Case(
                "signals", f"{name} {when}", f"{WORKING} 1", statuses=STATUSES[name], act=act
            )
    for name, status in CRUEL.items():
        act = sends(name, 4.0)
        yield Case(
            "signals",
            f"{name} and once more",
            f"{WORKING} 1",
            statuses=(status, 0),
            act=act,
            then=AGAIN,
        )


LIMITED = f"{WITHOUT_LIMIT} --workers 1 --time-limit"
CASES = [
    *options("limits", LIMITED, {f"--time-limit {value}": value for value in SHORT}, (0, 1)),
    *options("limits", LIMITED, {f"--time-limit {value}": value for value in LONG}, (0,)),
    *options(
        "limits",
        WORKING,
        {f"5s with {n} workers": f"{n} --time-limit 5s" for n in (0, 2)},
        (0, 1),
    ),
    *signals(),
]
