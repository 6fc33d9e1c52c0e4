"""Something else in the place of each file that a command reads."""

import os
import shutil
from pathlib import Path

import numpy as np
from attack import EITHER, REFUSED, Case
from room import (
    RECONSTRUCT,
    REPORTED,
    SUBMIT,
    makes,
    replaced,
    resumed,
)
from weight_bombs import AUTO, NAME, SEARCH

INSTEAD = {  # of a file
    "a directory": Path.mkdir,
    "a pipe": os.mkfifo,  # opening it waits for a writer
    "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "a link to nothing": lambda path: path.symlink_to("nothing"),
    "noise": lambda path: path.write_bytes(np.random.default_rng(1).bytes(5000)),
    "a sparse file of 1 TB": lambda path: [path.touch(), os.truncate(path, 1 << 40)],
}
X = "D/test_images/b1/x.png"
READ = {  # by its path: the command that reads it, and its allowed statuses
    "D/test.csv": (SUBMIT, REFUSED),
    X: (REPORTED, (0,)),
    "quick.toml": (SUBMIT, REFUSED),
    "I/0.png": (RECONSTRUCT, EITHER),
    "pairs.txt": (f"{RECONSTRUCT} --pairs pairs.txt", REFUSED),
    f"weights/deep/{NAME}": (AUTO, (0,)),
    "weights/deep/weights_manifest.txt": (f"weights verify {SEARCH}", (0,)),
    "truth.csv": ("score sub.csv --train-dir T --truth truth.csv", REFUSED),
    "T/scaling_factors.csv": (
        "validate --train-dir T --recipe quick.toml --workers 0",
        REFUSED,
    ),
    "out/s.work/journal.sqlite": (SUBMIT, EITHER),  # a link to nothing is followed
    "out/s.work/journal.lock": (SUBMIT, (0, 2)),
}
IMAGES = {
    "a link to another image": lambda path: path.symlink_to(path.with_name("z.png")),
    "a name in another case": lambda path: shutil.copy(
        path.with_name("z.png"), path.with_name("X.PNG")
    ),
}


def halve(room: Path) -> None:
    path = room / "out/s.work/journal.sqlite"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


CASES = [
    *(
        Case("files", f"{name} is {what}", command, resumed(replaced(name, make)), statuses)
        for name, (command, statuses) in READ.items()
        for what, make in INSTEAD.items()
    ),
    *makes("journals", SUBMIT, {"its first half, resumed": resumed(halve)}),
    *makes(
        "journals", f"{SUBMIT} --fresh", {"its first half, forgotten": resumed(halve)}, (0,)
    ),
    *makes("journals", "journal out/s.work", {"its first half, read": resumed(halve)}),
    *makes("files", SUBMIT, {name: replaced(X, make) for name, make in IMAGES.items()}, (0,)),
]
