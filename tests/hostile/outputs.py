"""Places where no result can be written, or that hold what must not be lost."""

import os
from collections.abc import Callable
from pathlib import Path

from attack import REFUSED, Case, nothing
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


def weights(room: Path) -> None:
    data, name = WEIGHTS
    (room / "W").mkdir()
    (room / name).write_bytes(data)


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
    Case("outputs", "text that the terminal has not", f"{PLAIN} --output out/s.csv", env=ASCII),
    Case("outputs", "the C locale", f"{PLAIN} --output out/\u00e9.csv", env=C, submission=False),
]
