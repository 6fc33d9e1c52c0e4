"""Paths where no result can be written, or that hold precious files; tests/cli/test_refusals.py has
more.
"""

import os

from attack import Case
from room import REPORTED, makes, options

IN_THE_WAY = {
    "a pipe for the journal's directory": lambda room: os.mkfifo(room / "out/s.work"),
    "a directory for the report": lambda room: (room / "out/s.html").mkdir(),
}
REPLACED = {
    "a link to itself": lambda room: (room / "out/s.csv").symlink_to("s.csv"),
    "a pipe": lambda room: os.mkfifo(room / "out/s.csv"),
    "a pipe for the partial file": lambda room: os.mkfifo(room / "out/.s.csv.part"),
    "a pipe for the report": lambda room: os.mkfifo(room / "out/s.html"),
}
TO = f"{REPORTED} --output"  # the last one counts
ODD = {"a line feed": "'out/a\nb.csv'", "new directories": "out/a/b/c/d/s.csv"}
CASES = [
    *options("outputs", TO, ODD, (0,), submission=False),
    *makes("outputs", f"{TO} out/s.csv", IN_THE_WAY),
    *makes("outputs", f"{TO} out/s.csv", REPLACED, (0,)),
    Case(
        "outputs",
        "text that the terminal has not",
        f"{TO} out/s.csv",
        env={"PYTHONIOENCODING": "ascii"},
    ),
    Case(
        "outputs",
        "the C locale",
        f"{TO} out/\u00e9.csv",
        env={"LC_ALL": "C"},
        submission=False,
    ),
]
