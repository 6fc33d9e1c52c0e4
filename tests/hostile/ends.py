"""Time limits without sense, and runs that are ended in every way."""

import os
import signal
import subprocess
import time

from attack import REFUSED, Act, Case
from room import SUBMIT

PLAIN = SUBMIT.replace(" --time-limit 5m", "").replace(" --workers 0", "")
NONE = {
    "--time-limit": ["0", "-1", "nan", "inf", "''", "1d", "0x10", "1h1h", "\uff11s s", "1e400"],
    "--started-at": ["nan", "-inf", "1e400", "abc", "99999999999", "''"],
    "--workers": ["-1", "''", "1.5", "99999999999999999999", "ray://", "\u0663x"],
    "--device": ["foo", "cuda:99", "''", "cpu:0", "cuda:-1", "meta"],
    "--mode": ["foo", "''"],
    "--recipe": ["foo", "''", "../quick", "D/test.csv", "/dev/null", "quick.toml/x.toml", "D", "x" * 5000],
    "--weights": ["foo", "D/test.csv", "/dev/null"],
}
LIMITS: dict[str, tuple[int, ...]] = {  # how a run under them ends; too short: as quick as the machine is
    **dict.fromkeys(("1s", "0.001s", "3s"), (0, 1)),
    **dict.fromkeys(("99999999999h", "' 60s '"), (0,)),
    **dict.fromkeys(("8h45", "5m5m", "1e3", "+60", "60S", "1e9"), REFUSED),
}
SOON = (0.6, 1.5, 3.0, 6.0)  # Python itself takes 0.1 s to start, more on a busy machine
ENDS = {"SIGINT": 130, "SIGTERM": 143}
CRUEL = {"SIGKILL": -9, "SIGHUP": -1, "SIGQUIT": -3, "SIGUSR1": -10, "SIGXCPU": -24, "SIGSEGV": -11}


def sends(name: str, *after: float, group: bool = False) -> Act:
    """Send the signal after so many seconds, and once more after each further time."""

    def act(process: "subprocess.Popen[bytes]") -> None:
        for seconds in after:
            time.sleep(seconds)
            if process.poll() is None:
                send = os.killpg if group else os.kill
                send(process.pid, signal.Signals[name])

    return act


LONG = PLAIN.replace("quick.toml", "classical")
STATUSES: dict[str, tuple[int, ...]] = {name: (0, status, -status + 128) for name, status in ENDS.items()}

WORKING = f"{LONG} --workers 1"
AGAIN = SUBMIT.replace("quick.toml", "classical")


CASES = [
    *(
        Case("limits", f"{option} {value[:20]}", f"{SUBMIT} {option}={value}", statuses=REFUSED)
        for option, values in NONE.items()
        for value in values
    ),
    *(
        Case("limits", f"--time-limit {value}", f"{PLAIN} --workers 1 --time-limit={value}", statuses=statuses)
        for value, statuses in LIMITS.items()
    ),
    *(
        Case("limits", f"5s with {n} workers", f"{LONG} --workers {n} --time-limit 5s", statuses=(0, 1))
        for n in (0, 2)
    ),
    *(
        Case("signals", f"{name} {when}", WORKING, statuses=STATUSES[name], act=act)
        for name in ENDS
        for when, act in (
            *((f"after {after} s", sends(name, after)) for after in SOON),
            *((f"to all after {after} s", sends(name, after, group=True)) for after in SOON[::2]),
            ("twice", sends(name, 3.0, 0.2)),
        )
    ),
    *(
        Case("signals", f"{name} and once more", WORKING, statuses=(status, 0), act=sends(name, 4.0), then=AGAIN)
        for name, status in CRUEL.items()
    ),
]
