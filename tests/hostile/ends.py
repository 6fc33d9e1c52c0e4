"""Arguments without sense, and runs that are ended in every way."""

import os
import signal
import subprocess
import time
from collections.abc import Iterator

from attack import REFUSED, Act, Case
from room import CALIBRATION, SUBMIT, makes, options, written

WITHOUT_LIMIT = SUBMIT.replace(" --time-limit 5m", "").replace(" --workers 0", "")
NONSENSE = {
    "--time-limit": [
        "0",
        "-1",
        "nan",
        "inf",
        "''",
        "1d",
        "0x1",
        "1h1h",
        "'\uff11s s'",
        "1e400",
        "8h4",
        "+6",
    ],
    "--started-at": ["nan", "-inf", "1e400", "abc", "99999999999", "''"],
    "--workers": ["-1", "''", "1.5", "99999999999999999999", "ray://", "\u0663x"],
    "--device": ["foo", "cuda:99", "''", "cpu:0", "cuda:-1", "meta"],
    "--recipe": [
        "foo",
        "''",
        "../quick",
        "D/test.csv",
        "/dev/null",
        "quick.toml/x.toml",
        "D",
        "x" * 5000,
    ],
    "--weights": ["foo", "D/test.csv", "/dev/null"],
    "--test-dir": ["d" * 5000],
}
VALIDATE = "validate --train-dir T --recipe quick.toml --workers 0 --no-scenes --pairs-per-scene 1"
SCENES = {
    "covisibility of NaN": "--min-covisibility nan",
    "a scene above": "--scenes ../T",
    "figures in a directory": "--json out",
    "figures in the table": "--json T/scaling_factors.csv",
}
HEADER = "sample_id,fundamental_matrix\n"
SUBMITTED_NAN = written("sub.csv", f"{HEADER}1,nan nan nan nan nan nan nan nan nan\n")
# Numbers that a competition's own reader may take, and that no score can use.
SUBMISSIONS = {
    "a submission of NaN": SUBMITTED_NAN,
    "a submission of huge numbers": written("sub.csv", f"{HEADER}1,1e308 1e308 1 1 1 1 1 1 1\n"),
}
CLEARED = r"a\x1b[2J\n: no"
SCORE = "score sub.csv --train-dir T --truth truth.csv"
# Time limits that end the run early, and limits that do not
SHORT = ("1s", "0.001s", "3s")
LONG = ("99999999999h", "' 60s '")
SOON = (0.6, 1.5, 3.0, 6.0)  # Python itself takes 0.1 s to start, more on a busy machine
ENDS = {"SIGINT": 130, "SIGTERM": 143}
STATUSES = {name: (0, status, -status + 128) for name, status in ENDS.items()}
# Signals that the program does not handle: the kernel ends it, and the next run must resume.
CRUEL = {"SIGKILL": -9, "SIGHUP": -1, "SIGQUIT": -3, "SIGUSR1": -10, "SIGXCPU": -24, "SIGSEGV": -11}
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
        acts |= {f"to all after {after} s": sends(name, after, group=True) for after in SOON[::2]}
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
WITHOUT_NUMBERS = {
    "cameras of NaN": written(
        "T/s/calibration.csv", CALIBRATION.replace("200 0 80", "nan nan nan")
    ),
}
# It has numbers, and scores of it have no meaning.
WITHOUT_ROTATION = {
    "a rotation that is none": written(
        "T/s/calibration.csv", CALIBRATION.replace("1 0 0", "1 2 3")
    ),
}
CASES = [
    *(
        case
        for option, values in NONSENSE.items()
        for case in options(
            "limits", SUBMIT, {f"{option} {value[:20]}": f"{option}={value}" for value in values}
        )
    ),
    *options("limits", LIMITED, {f"--time-limit {value}": value for value in SHORT}, (0, 1)),
    *options("limits", LIMITED, {f"--time-limit {value}": value for value in LONG}, (0,)),
    *options(
        "limits", WORKING, {f"5s with {n} workers": f"{n} --time-limit 5s" for n in (0, 2)}, (0, 1)
    ),
    *options("arguments", VALIDATE, SCENES),
    *makes("arguments", VALIDATE, WITHOUT_NUMBERS),
    *makes("arguments", VALIDATE, WITHOUT_ROTATION, (0,)),
    *makes("arguments", SCORE, SUBMISSIONS, (0,)),
    *makes(
        "arguments",
        "check sub.csv --test-dir D",
        {"a checked submission of NaN": SUBMITTED_NAN},
        (1,),
    ),
    Case(
        "arguments",
        "a name that clears the screen",
        "match 'a\x1b[2J\n' b",
        statuses=REFUSED,
        says=CLEARED,
    ),
    Case(
        "arguments",
        "an empty submission",
        SCORE,
        written("sub.csv", ""),
        REFUSED,
        "missing columns",
    ),
    Case(
        "arguments", "an owner that is a path", "package --out out/p --owner ../x", statuses=REFUSED
    ),
    *signals(),
]
