"""Paths where no result can be written, or that hold precious files; tests/data/test_outputs.py has more."""

import os
from collections.abc import Callable
from pathlib import Path

from attack import Case, Make, nothing
from room import REPORTED, makes, options, resumed

REFUSALS = {
    "the table": "D/test.csv",
    "an image": "D/test_images/b1/x.png",
    "the report's place": "out/s.html --report out/s.html",
    "a name that ends as work directories do": "out/q.work",
    "a name of 300 characters": f"out/{'s' * 300}.csv",
    "below /proc": "/proc/s.csv",
    "the submission in the lock's place": "out/journal.lock --work-dir out",
    "the full device": "/dev/full",
    "the journal among the images": "out/s.csv --work-dir D/test_images",
}
IN_THE_WAY = {
    "a link to the table": lambda room: (room / "out/s.csv").symlink_to("../D/test.csv"),
    "a hard link to the table": lambda room: os.link(room / "D/test.csv", room / "out/s.csv"),
    "a pipe for the journal's directory": lambda room: os.mkfifo(room / "out/s.work"),
    "a directory for the report": lambda room: (room / "out/s.html").mkdir(),
}
REPLACED = {
    "a link to itself": lambda room: (room / "out/s.csv").symlink_to("s.csv"),
    "a pipe": lambda room: os.mkfifo(room / "out/s.csv"),
    "a pipe for the partial file": lambda room: os.mkfifo(room / "out/.s.csv.part"),
    "a pipe for the report": lambda room: os.mkfifo(room / "out/s.html"),
}
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
EXPORTS_OVER = {
    "a table of the user's": lambda folder: mine(folder / "pairs.csv"),
    "a link to an image": lambda folder: (folder / "units.csv").symlink_to("../D/test_images/b1/x.png"),
    "a link to the journal": lambda folder: (folder / "regions.csv").symlink_to("../out/s.work/journal.sqlite"),
    "a link to nothing": lambda folder: (folder / "units.csv").symlink_to("nothing"),
    "a pipe": lambda folder: os.mkfifo(folder / "units.csv"),
    "a directory": lambda folder: (folder / "units.csv").mkdir(),
    "/dev/zero": lambda folder: (folder / "units.csv").symlink_to("/dev/zero"),
}


def in_folder(table: dict[str, Callable[[Path], object]]) -> dict[str, Make]:
    """Return how to put the results of a finished run, and a folder U of the user, into the room."""
    makings = {name: lambda room, m=make: [(room / "U").mkdir(), m(room / "U")] for name, make in table.items()}
    return {name: resumed(make) for name, make in makings.items()}


MATCH = "match D/test_images/b1/x.png D/test_images/b1/y.png --recipe quick.toml --out"
EXPORT = "journal out/s.work --csv"
TO = f"{REPORTED} --output"  # the last one counts
ODD = {"a line feed": "'out/a\nb.csv'", "new directories": "out/a/b/c/d/s.csv"}
CASES = [
    *options("outputs", TO, REFUSALS),
    *options("outputs", TO, ODD, (0,), submission=False),
    *makes("outputs", f"{TO} out/s.csv", IN_THE_WAY),
    *makes("outputs", f"{TO} out/s.csv", REPLACED, (0,)),
    Case("outputs", "text that the terminal has not", f"{TO} out/s.csv", env={"PYTHONIOENCODING": "ascii"}),
    Case("outputs", "the C locale", f"{TO} out/\u00e9.csv", env={"LC_ALL": "C"}, submission=False),
    *options("figures", MATCH, FIGURES),
    Case("figures", "capitals", f"{MATCH} out/a.PNG"),
    *options("demos", "demo", DEMOS),
    *makes("demos", "demo --out U", in_folder(DEMOS_OVER), says="in the way"),
    Case("demos", "given again", "demo --out out/d", then="demo --out out/d --seed 1"),
    *makes("exports", f"{EXPORT} U", in_folder(EXPORTS_OVER), says="is no such table"),
    Case("exports", "given again", f"{EXPORT} out/t", resumed(nothing), then=f"{EXPORT} out/t"),
]
