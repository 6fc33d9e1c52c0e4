"""Paths where no result can be written, or that hold precious files; tests/data/test_outputs.py has more."""

import os
from collections.abc import Callable
from pathlib import Path

from attack import REFUSED, Case, nothing
from journals import damaged
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
DEMOS: dict[str, Callable[[Path], object]] = {  # in the folder U of the user
    "a train side of the user's": lambda folder: mine(folder / "train" / "scaling_factors.csv"),
    "a truth of the user's": lambda folder: mine(folder / "test_truth.csv"),
    "a link to a train side": lambda folder: (folder / "train").symlink_to("../D"),
    "a link to nothing for the mark": lambda folder: (folder / "demo.txt").symlink_to("../nothing"),
    "a pipe for the mark": lambda folder: os.mkfifo(folder / "demo.txt"),
    "another mark": lambda folder: [mine(folder / "demo.txt"), mine(folder / "test_truth.csv")],
}
EXPORTS: dict[str, Callable[[Path], object]] = {
    "a table of the user's": lambda folder: mine(folder / "pairs.csv"),
    "a link to an image": lambda folder: (folder / "units.csv").symlink_to("../D/test_images/b1/x.png"),
    "a link to the journal": lambda folder: (folder / "regions.csv").symlink_to("../out/s.work/journal.sqlite"),
    "a link to nothing": lambda folder: (folder / "units.csv").symlink_to("nothing"),
    "a pipe": lambda folder: os.mkfifo(folder / "units.csv"),
    "a directory": lambda folder: (folder / "units.csv").mkdir(),
    "/dev/zero": lambda folder: (folder / "units.csv").symlink_to("/dev/zero"),
}


def mine(path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text("mine")


def in_folder(make: Callable[[Path], object]) -> Callable[[Path], None]:
    """The results of a finished run, and a folder U of the user."""

    def write(room: Path) -> None:
        damaged(nothing)(room)
        (room / "U").mkdir()
        make(room / "U")

    return write


def placed(make: Callable[[Path], object]) -> Callable[[Path], None]:
    return lambda room: nothing(make(room / "out" / "s.csv"))


MATCH = "match D/test_images/b1/x.png D/test_images/b1/y.png --recipe quick.toml"
EXPORT = "journal out/s.work --csv"
PLAIN = SUBMIT.replace("--output out/s.csv --no-report ", "")
ASCII, C = {"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C"}
CASES = [
    *(Case("outputs", name, f"{PLAIN} {options}", statuses=REFUSED) for name, options in INPUTS.items()),
    *(Case("outputs", name, f"{PLAIN} {options}", submission=False) for name, options in ODD.items()),
    *(
        Case("outputs", f"there is {name}", f"{PLAIN} --output out/s.csv", placed(make), statuses)
        for name, (make, statuses) in IN_THE_WAY.items()
    ),
    *(Case("figures", name, f"{MATCH} --out {out}", statuses=REFUSED) for name, out in FIGURES.items()),
    Case("figures", "capitals", f"{MATCH} --out out/a.PNG"),
    *(Case("demos", name, "demo --out U", in_folder(make), REFUSED, "in the way") for name, make in DEMOS.items()),
    Case("demos", "a name of 300 characters", f"demo --out out/{'d' * 300}", statuses=REFUSED),
    Case("demos", "a seed of 5,000 digits", f"demo --out out/d --seed {'9' * 5000}", statuses=REFUSED),
    Case("demos", "given again", "demo --out out/d", then="demo --out out/d --seed 1"),
    *(
        Case("exports", name, f"{EXPORT} U", in_folder(make), REFUSED, "is no such table")
        for name, make in EXPORTS.items()
    ),
    Case("exports", "given again", f"{EXPORT} out/t", damaged(nothing), then=f"{EXPORT} out/t"),
    Case("outputs", "text that the terminal has not", f"{PLAIN} --output out/s.csv", env=ASCII),
    Case("outputs", "the C locale", f"{PLAIN} --output out/\u00e9.csv", env=C, submission=False),
]
