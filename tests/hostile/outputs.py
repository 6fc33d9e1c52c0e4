"""Paths where no result can be written, or that hold precious files; tests/data/test_outputs.py has more."""

import os
from collections.abc import Callable
from pathlib import Path

from attack import REFUSED, Case, nothing
from room import SUBMIT

INPUTS = {
    "the table": "--output D/test.csv",
    "an image": "--output D/test_images/b1/x.png",
    "the report's place": "--output out/s.html --report out/s.html",
    "a name that ends as work directories do": "--output out/q.work",
    "a name of 300 characters": f"--output out/{'s' * 300}.csv",
    "below /proc": "--output /proc/s.csv",
    "the submission in the lock's place": "--work-dir out --output out/journal.lock",
    "the full device": "--output /dev/full",
    "the journal among the images": "--output out/s.csv --work-dir D/test_images",
}
ODD = {
    "a name with a line feed": "--output 'out/a\nb.csv'",
    "directories that are not there": "--output out/a/b/c/d/s.csv",
}
IN_THE_WAY: dict[str, tuple[Callable[[Path], object], tuple[int, ...]]] = {
    "a link to the table": (lambda path: path.symlink_to("../D/test.csv"), REFUSED),
    "a hard link to the table": (lambda path: os.link(path.parent.parent / "D" / "test.csv", path), REFUSED),
    "a pipe for the journal's directory": (lambda path: os.mkfifo(path.with_suffix(".work")), REFUSED),
    "a directory for the report": (lambda path: path.with_suffix(".html").mkdir(), REFUSED),
    "a link to itself": (lambda path: path.symlink_to(path), (0,)),
    "a pipe": (os.mkfifo, (0,)),
    "a pipe for the partial file": (lambda path: os.mkfifo(path.with_name(".s.csv.part")), (0,)),
    "a pipe for the report": (lambda path: os.mkfifo(path.with_suffix(".html")), (0,)),
}


def placed(make: Callable[[Path], object]) -> Callable[[Path], None]:
    return lambda room: nothing(make(room / "out" / "s.csv"))


PLAIN = SUBMIT.replace("--output out/s.csv --no-report ", "")
ASCII, C = {"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C"}
CASES = [
    *(Case("outputs", name, f"{PLAIN} {options}", statuses=REFUSED) for name, options in INPUTS.items()),
    *(Case("outputs", name, f"{PLAIN} {options}", submission=False) for name, options in ODD.items()),
    *(
        Case("outputs", f"there is {name}", f"{PLAIN} --output out/s.csv", placed(make), statuses)
        for name, (make, statuses) in IN_THE_WAY.items()
    ),
    Case("outputs", "text that the terminal has not", f"{PLAIN} --output out/s.csv", env=ASCII),
    Case("outputs", "the C locale", f"{PLAIN} --output out/\u00e9.csv", env=C, submission=False),
]
