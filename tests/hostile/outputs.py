"""Places where no result can be written, or that hold what must not be lost."""

import os
from collections.abc import Callable
from pathlib import Path

from attack import REFUSED, Case, nothing, prepared
from room import SUBMIT

INPUTS = {
    "the table": "--output D/test.csv",
    "the table by another way": "--output D/test_images/../test.csv",
    "an image": "--output D/test_images/b1/x.png",
    "the images' directory": "--output D/test_images",
    "the recipe": "--output quick.toml",
    "no name": "--output ''",
    "here": "--output .",
    "the root": "--output /",
    "a directory": "--output out/",
    "the report's place": "--output out/s.html --report out/s.html",
    "a page without a report's name": "--output out/s.html",
    "the work directory": "--output out/s.work --work-dir out/s.work",
    "a name that ends as work directories do": "--output out/q.work",
    "the report in the table's place": "--output out/s.csv --report D/test.csv",
    "the report in the submission's place": "--output out/s.csv --report out/s.csv",
    "the report in an image's place": "--output out/s.csv --report D/test_images/b1/x.png",
    "the journal in the table's place": "--output out/s.csv --work-dir D/test.csv",
    "a name of 300 characters": f"--output out/{'s' * 300}.csv",
    "below a file": "--output D/test.csv/s.csv",
    "below /proc": "--output /proc/s.csv",
    "below /dev/null": "--output /dev/null/s.csv",
    "the submission in the journal's place": "--work-dir out --output out/journal.sqlite",
    "the submission in the lock's place": "--work-dir out --output out/journal.lock",
    "the null device": "--output /dev/null",
    "the full device": "--output /dev/full",
    "the journal among the images": "--output out/s.csv --work-dir D/test_images",
    "no name for the report": "--output out/s.csv --report ''",
    "a directory for the report": "--output out/s.csv --report out",
}
ODD = {
    "a name with a line feed": "--output 'out/a\nb.csv'",
    "a name of other scripts": "--output out/\u202e\U0001f600.csv",
    "no suffix": "--output out/s",
    "two suffixes": "--output out/s.csv.gz",
    "directories that are not there": "--output out/a/b/c/d/s.csv",
}
IN_THE_WAY: dict[str, Callable[[Path], object]] = {
    "a link to the table": lambda path: path.symlink_to("../D/test.csv"),
    "a hard link to the table": lambda path: os.link(path.parent.parent / "D" / "test.csv", path),
    "a directory": Path.mkdir,
    "a file for the journal's directory": lambda path: path.with_suffix(".work").write_text("old"),
    "a pipe for the journal's directory": lambda path: os.mkfifo(path.with_suffix(".work")),
    "a link for the report": lambda path: path.with_suffix(".html").symlink_to("../D/test.csv"),
    "a directory for the report ": lambda path: path.with_suffix(".html").mkdir(),
}
THERE: dict[str, Callable[[Path], object]] = {
    "a link to itself": lambda path: path.symlink_to(path),
    "a link to nothing": lambda path: path.symlink_to("nothing.csv"),
    "a pipe": os.mkfifo,
    "an older file": lambda path: path.write_text("old"),
    "a directory for the partial file": lambda path: path.with_name(".s.csv.part").mkdir(),
    "a link for the partial file": lambda path: path.with_name(".s.csv.part").symlink_to("../D/test.csv"),
    "a pipe for the partial file": lambda path: os.mkfifo(path.with_name(".s.csv.part")),
    "a pipe for the report": lambda path: os.mkfifo(path.with_suffix(".html")),
}
WEIGHTS = (b"\x08\x00\x00\x00\x00\x00\x00\x00{}      ", "W/w.safetensors")  # a file without tensors
OVER = {
    "a weight file": "submit --test-dir D --recipe quick.toml --weights W --output W/w.safetensors",
    "a drawing in an image's place": "match D/test_images/b1/x.png quick.toml --out D/test_images/b1/x.png",
    "an export in the table's place": "journal out/s.work --report D/test.csv",
    "a page in an image's place": "journal out/s.work --report D/test_images/b1/x.png",
    "a conversion in its source's place": "weights convert W/w.safetensors --out W/w.safetensors",
}


FIGURES = {
    "a photograph's name without its suffix": "D/test_images/b1/x",
    "another photograph's": "D/test_images/b1/z",
    "the recipe's name without its suffix": "quick",
    "no suffix": "out/notes",
    "a suffix that is no picture's": "out/a.xyz",
    "a suffix that needs LaTeX": "out/a.pgf",
    "a dot after the suffix": "out/a.png.",
    "a suffix alone": "out/.png",
    "the full device": "/dev/full",
    "the null device": "/dev/null",
    "the screen": "/dev/stdout",
}
USERS: dict[str, Callable[[Path], object]] = {  # in the folder U of the user
    "a train side of the user's": lambda folder: mine(folder / "train" / "scaling_factors.csv"),
    "a test side of the user's": lambda folder: mine(folder / "test" / "test.csv"),
    "a truth of the user's": lambda folder: mine(folder / "test_truth.csv"),
    "a link to a train side": lambda folder: (folder / "train").symlink_to("../D"),
    "a link to nothing for the mark": lambda folder: (folder / "demo.txt").symlink_to("../nothing"),
    "a pipe for the mark": lambda folder: os.mkfifo(folder / "demo.txt"),
    "another mark": lambda folder: [mine(folder / "demo.txt"), mine(folder / "test_truth.csv")],
}
DEMOS = {
    "a file": "--out D/test.csv",
    "below a file": "--out D/test.csv/d",
    "below /proc": "--out /proc/d",
    "the null device": "--out /dev/null",
    "a name of 300 characters": f"--out out/{'d' * 300}",
    "a seed below none": "--out out/d --seed -1",
    "a seed of text": "--out out/d --seed x",
    "a seed of 5,000 digits": f"--out out/d --seed {'9' * 5000}",
}
EXPORTS: dict[str, Callable[[Path], object]] = {
    "a table of the user's": lambda folder: mine(folder / "pairs.csv"),
    "another table of the user's": lambda folder: mine(folder / "events.csv"),
    "a link to the test set": lambda folder: (folder / "pairs.csv").symlink_to("../D/test.csv"),
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
    def write(room: Path) -> None:
        (room / "U").mkdir()
        make(room / "U")

    return write


def exported(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def write(room: Path) -> None:
        prepared(SUBMIT, room)
        in_folder(make)(room)

    return write


def weights(room: Path) -> None:
    data, name = WEIGHTS
    (room / "W").mkdir()
    (room / name).write_bytes(data)


B1 = "D/test_images/b1"
PLAIN = SUBMIT.replace("--output out/s.csv --no-report ", "")


ASCII, C = {"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C"}


def placed(make: Callable[[Path], object]) -> Callable[[Path], None]:
    return lambda room: nothing(make(room / "out" / "s.csv"))


CASES = [
    *(Case("outputs", name, f"{PLAIN} {options}", statuses=REFUSED) for name, options in INPUTS.items()),
    *(
        Case("outputs", name, f"{PLAIN} {options}", submission="out/s.csv " in f"{options} ")
        for name, options in ODD.items()
    ),
    *(
        Case("outputs", f"there is {name}", f"{PLAIN} --output out/s.csv", placed(make), statuses)
        for table, statuses in ((THERE, (0,)), (IN_THE_WAY, REFUSED))
        for name, make in table.items()
    ),
    *(Case("outputs", name, command, weights, REFUSED, "name another") for name, command in OVER.items()),
    *(
        Case("figures", name, f"match {B1}/x.png {B1}/y.png --recipe quick.toml --out {out}", statuses=REFUSED)
        for name, out in FIGURES.items()
    ),
    Case("figures", "capitals", f"match {B1}/x.png {B1}/y.png --recipe quick.toml --out out/a.PNG"),
    *(Case("demos", name, "demo --out U", in_folder(make), REFUSED, "in the way") for name, make in USERS.items()),
    *(Case("demos", name, f"demo {options}", statuses=REFUSED) for name, options in DEMOS.items()),
    Case("demos", "given again", "demo --out out/d", then="demo --out out/d --seed 1"),
    *(
        Case("exports", name, "journal out/s.work --csv U", exported(make), REFUSED, "is no such table")
        for name, make in EXPORTS.items()
    ),
    Case(
        "exports",
        "given again",
        "journal out/s.work --csv out/t",
        exported(nothing),
        then="journal out/s.work --csv out/t",
    ),
    Case("outputs", "text that the terminal has not", f"{PLAIN} --output out/s.csv", env=ASCII),
    Case("outputs", "the C locale", f"{PLAIN} --output out/\u00e9.csv", env=C, submission=False),
]
