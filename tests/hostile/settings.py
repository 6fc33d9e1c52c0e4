"""Recipes as nobody should write them, and arguments of ``validate`` and ``package`` that make no sense."""

import os
from collections.abc import Callable
from pathlib import Path

from attack import REFUSED, Case
from room import RECIPE, SUBMIT, encoded, picture, write_sparse

UNIT = 'units = [{ stage = 1, matcher = "sift", long_side = 200 }]\n'
RECIPES = {  # tests/test_recipe.py has the values that are out of range
    "a size of 5,000 digits": UNIT.replace("200", "9" * 5000),
    "a module that is not a matcher": UNIT.replace("sift", "registry"),
    "deep lists": "units = " + "[" * 100_000,
    "deep tables": "units = " + "{a=" * 20_000,
    "a byte order mark": "\ufeff" + RECIPE,
    "lines of another system": RECIPE.replace("\n", "\r\n"),
    "a million comments": "# nothing\n" * 1_000_000 + RECIPE,
    "10,000 units": "units = [" + 10_000 * '{ stage = 1, matcher = "sift", long_side = 200 },' + "]",
}
VALID = ("a byte order mark", "lines of another system", "a million comments")

PLACES: dict[str, Callable[[Path], object]] = {
    "a directory": Path.mkdir,
    "a pipe": os.mkfifo,
    "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "bytes that are not text": lambda path: path.write_bytes(b"\xff\xfe\x00"),
    "a sparse file of 1 TB": write_sparse,
}

CALIBRATION = "image_id,camera_intrinsics,rotation_matrix,translation_vector\n" + "".join(
    f"{name},200 0 80 0 200 80 0 0 1,1 0 0 0 1 0 0 0 1,{shift} 0 0\n" for shift, name in enumerate("xyz")
)
VALIDATE = "validate --train-dir T --recipe quick.toml --workers 0 --no-scenes"
CHECK = "check out/sub.csv --test-dir D"
SCORE = "validate --train-dir T --submission out/sub.csv --truth truth.csv"
ARGUMENTS = {
    "covisibility of NaN": "--min-covisibility nan",
    "a scene above": "--scenes ../T",
    "figures in a directory": "--json out --pairs-per-scene 1",
    "figures in the table": "--json T/scaling_factors.csv --pairs-per-scene 1",
}
ROW = "1," + " ".join("123456789")
SUBMISSIONS = {
    "empty": "",
    "of NaN": "sample_id,fundamental_matrix\n1,nan nan nan nan nan nan nan nan nan\n",
    "of huge numbers": "sample_id,fundamental_matrix\n1,1e308 1e308 1 1 1 1 1 1 1\n",
}


def recipe(text: str) -> Callable[[Path], object]:
    return lambda room: (room / "quick.toml").write_bytes(text.encode())


def replaced(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def replace(room: Path) -> None:
        (room / "quick.toml").unlink()
        make(room / "quick.toml")

    return replace


def train_side(former: str = "", new: str = "", submission: str = "") -> Callable[[Path], None]:
    """A train side of one scene, with a change to its cameras, and a submission with the sample's truth."""

    def make(room: Path) -> None:
        images = room / "T" / "s" / "images"
        images.mkdir(parents=True)
        for number, image in enumerate("xyz"):
            (images / f"{image}.jpg").write_bytes(encoded(".jpg", picture(12 * number)))
        (room / "T" / "scaling_factors.csv").write_text("scene,scaling_factor\ns,1.5\n")
        (room / "T" / "s" / "calibration.csv").write_text(
            CALIBRATION.replace(former, new) if former else CALIBRATION
        )
        (room / "T" / "s" / "pair_covisibility.csv").write_text("pair,covisibility\nx-y,0.9\ny-z,0.8\nx-z,0.05\n")
        (room / "truth.csv").write_text("sample_id,scene,image_1_id,image_2_id\n1,s,x,y\n")
        (room / "out" / "sub.csv").write_text(submission or f"sample_id,fundamental_matrix\n{ROW}\n")

    return make


CASES = [
    *(
        Case("recipes", name, SUBMIT, recipe(text), (0,) if name in VALID else REFUSED)
        for name, text in RECIPES.items()
    ),
    *(Case("recipes", name, SUBMIT, replaced(make), REFUSED) for name, make in PLACES.items()),
    *(
        Case("arguments", name, f"{VALIDATE} {options}", train_side(), REFUSED)
        for name, options in ARGUMENTS.items()
    ),
    Case("arguments", "cameras of NaN", f"{VALIDATE} --pairs-per-scene 1", train_side("200 0 80", "nan nan nan")),
    Case("arguments", "a rotation that is none", f"{VALIDATE} --pairs-per-scene 1", train_side("1 0 0", "1 2 3")),
    *(
        Case("arguments", f"a submission {name}", SCORE, train_side(submission=text))
        for name, text in SUBMISSIONS.items()
    ),
    Case("arguments", "check of a submission of NaN", CHECK, train_side(submission=SUBMISSIONS["of NaN"]), (1,)),
    Case("arguments", "an owner that is a path", "package --out out/p --owner ../x", statuses=REFUSED),
]
