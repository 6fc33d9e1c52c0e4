"""Something else in the place of each file that a command reads."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from attack import EITHER, REFUSED, Case
from room import (
    HEADER,
    RECIPE,
    RECONSTRUCT,
    REPORTED,
    SUBMIT,
    TABLE,
    UNIT,
    makes,
    replaced,
    resumed,
    written,
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
    "T/scaling_factors.csv": ("validate --train-dir T --recipe quick.toml --workers 0", REFUSED),
    "out/s.work/journal.sqlite": (SUBMIT, (0, 2)),  # a link to nothing is followed
    "out/s.work/journal.lock": (SUBMIT, (0, 2)),
}
ROW = "b1;x-y,b1,x,y\n"
TABLES = {
    "a batch further above": HEADER + "1,../../etc,x,y\n",
    "UTF-16": TABLE.encode("utf-16"),
    "bytes that are not UTF-8": TABLE.encode().replace(b"x-y", b"\xff\xfe"),
    "a hundred thousand columns": HEADER.strip() + ",c" * 100_000 + "\n" + ROW,
    "a cell of 10 MB": HEADER + "1,b1,x,y\n2,b1,x," + "y" * 10_000_000 + "\n",
}
GOOD_TABLES = {
    "a byte order mark": b"\xef\xbb\xbf" + TABLE.encode(),
    "lines of another system": TABLE.replace("\n", "\r\n"),
    "a very long sample id": HEADER + "s" * 100_000 + ",b1,x,y\n",
    "a batch id of 5,000 characters": HEADER + "1," + "b" * 5000 + ",x,y\n2,b1,x,y\n",
}
NO_IMAGES = HEADER + "".join(f"{n},b1,p{n},q{n}\n" for n in range(5000))
ACCENTED = written("D/test.csv", HEADER + "1,\u00e9,x,y\n2,b1,x,y\n")
C = {"LC_ALL": "C", "PYTHONUTF8": "0"}
RECIPES = {  # tests/test_recipe.py has the values that are out of range
    "a size of 5,000 digits": RECIPE.replace("200", "9" * 5000),
    "a module that is not a matcher": RECIPE.replace("sift", "registry"),
    "deep lists": "units = " + "[" * 100_000,
    "deep tables": "units = " + "{a=" * 20_000,
    "10,000 units": f"units = [{10_000 * (UNIT.format(1) + ',')}]",
}
GOOD_RECIPES = {
    "a byte order mark": "\ufeff" + RECIPE,
    "lines of another system": RECIPE.replace("\n", "\r\n"),
    "a million comments": "# nothing\n" * 1_000_000 + RECIPE,
}
IMAGES = {
    "a link to another image": lambda path: path.symlink_to(path.with_name("z.png")),
    "a name in another case": lambda path: shutil.copy(
        path.with_name("z.png"), path.with_name("X.PNG")
    ),
}


def tables_of(name: str, texts: dict[str, bytes | str]) -> dict[str, Callable[[Path], None]]:
    return {what: written(name, text) for what, text in texts.items()}


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
    *makes("journals", f"{SUBMIT} --fresh", {"its first half, forgotten": resumed(halve)}, (0,)),
    *makes("journals", "journal out/s.work --csv out/t", {"its first half, read": resumed(halve)}),
    *makes("files", SUBMIT, {name: replaced(X, make) for name, make in IMAGES.items()}, (0,)),
    *makes("tables", SUBMIT, tables_of("D/test.csv", TABLES)),
    *makes("tables", SUBMIT, tables_of("D/test.csv", GOOD_TABLES), (0,)),
    Case("tables", "5,000 pairs of no images", SUBMIT, written("D/test.csv", NO_IMAGES), (1,)),
    Case("tables", "a batch that the locale lacks", SUBMIT, ACCENTED, says="1 of 2 pairs", env=C),
    *makes("recipes", SUBMIT, tables_of("quick.toml", RECIPES)),
    Case(
        "recipes",
        "17 MiB",
        SUBMIT,
        written("quick.toml", "#" * (17 << 20)),
        REFUSED,
        "the limit is 16 MiB",
    ),
    *makes("recipes", SUBMIT, tables_of("quick.toml", GOOD_RECIPES), (0,)),
]
