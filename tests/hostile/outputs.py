"""Paths where no result can be written, or that hold precious files; tests/cli/test_refusals.py has
more.
"""

import os
from collections.abc import Callable
from pathlib import Path

from attack import Case, Make
from room import REPORTED, makes, options, resumed

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
# matplotlib adds a suffix where a name has none, and so wrote over a photograph.
FIGURES = {
    "a photograph's name without its suffix": "D/test_images/b1/x",
    "the recipe's name without its suffix": "quick",
    "a suffix that is no picture's": "out/a.xyz",
    "a suffix that needs LaTeX": "out/a.pgf",
    "a dot after the suffix": "out/a.png.",
    "a suffix alone": "out/.png",
    "the full device": "/dev/full",
    "the screen": "/dev/stdout",
}
DEMOS = {
    "a name of 300 characters": f"--out out/{'d' * 300}",
    "a file": "--out quick.toml",
    "below a file": "--out quick.toml/d",
    "below /proc": "--out /proc/d",
    "a seed below none": "--out out/d --seed -1",
    "a seed of 5,000 digits": f"--out out/d --seed {'9' * 5000}",
}


def mine(path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text("mine")


DEMOS_OVER = {  # in the folder U of the user
    "a train side of the user's": lambda folder: mine(folder / "train" / "scaling_factors.csv"),
    "a truth of the user's": lambda folder: mine(folder / "test_truth.csv"),
    "a link to a train side": lambda folder: (folder / "train").symlink_to("../D"),
    "a link to nothing for the mark": lambda folder: (folder / "demo.txt").symlink_to("../nothing"),
    "a pipe for the mark": lambda folder: os.mkfifo(folder / "demo.txt"),
    "another mark": lambda folder: [mine(folder / "demo.txt"), mine(folder / "test_truth.csv")],
}


def in_folder(table: dict[str, Callable[[Path], object]]) -> dict[str, Make]:
    """Return how to put the results of a finished run, and a folder U of the user, into the room."""
    makings = {
        name: lambda room, m=make: [(room / "U").mkdir(), m(room / "U")]
        for name, make in table.items()
    }
    return {name: resumed(make) for name, make in makings.items()}


MATCH = "match D/test_images/b1/x.png D/test_images/b1/y.png --recipe quick.toml --out"
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
    Case("outputs", "the C locale", f"{TO} out/\u00e9.csv", env={"LC_ALL": "C"}, submission=False),
    *options("figures", MATCH, FIGURES),
    Case("figures", "capitals", f"{MATCH} out/a.PNG"),
    *options("demos", "demo", DEMOS),
    *makes("demos", "demo --out U", in_folder(DEMOS_OVER), says="in the way"),
    Case("demos", "given again", "demo --out out/d", then="demo --out out/d --seed 1"),
]
