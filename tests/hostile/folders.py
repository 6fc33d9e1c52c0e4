"""Folders of images to reconstruct: odd names and images, results in the way, lists of pairs, runs given again.

tests/reconstruction has more directories of results and lists of pairs.
"""

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

from attack import EITHER, REFUSED, Act, Case, nothing
from ends import ENDS, STATUSES, sends
from images import DAMAGES, ODD, PLACES
from room import RECIPE, encoded, picture

OPTIONS = "--recipe quick.toml --workers 0 --time-limit 5m"
PLAIN = f"reconstruct out/i {OPTIONS} --out out/o".replace("quick.toml", "out/quick.toml")
WATCHED = f"reconstruct I {OPTIONS} --out out/o"  # the images must stay as they are
TAKEN = (0, 1)  # three small images need not give a model


def write_images(folder: Path, count: int = 3) -> None:
    folder.mkdir(parents=True)
    for number in range(count):
        (folder / f"{number}.png").write_bytes(encoded(".png", picture(8 * number)))


def with_images(make: Callable[[Path], object] = nothing) -> Callable[[Path], None]:
    """Three images in the folder I, then ``make``."""

    def whole(room: Path) -> None:
        write_images(room / "I")
        make(room)

    return whole


def of_the_user(name: str, text: str = "mine") -> Callable[[Path], None]:
    def make(room: Path) -> None:
        path = room / "P" / name
        path.parent.mkdir(parents=True)
        path.write_text(text)

    return with_images(make)


def image_named(name: bytes) -> Callable[[Path], None]:
    def make(room: Path) -> None:
        with open(os.path.join(os.fsencode(room / "I"), name + b".png"), "wb") as stream:  # noqa: PTH118, PTH123
            stream.write(encoded(".png", picture(30)))

    return with_images(make)


def folder_named(name: bytes) -> Callable[[Path], None]:
    def make(room: Path) -> None:
        write_images(room / "J")
        os.rename(room / "J", os.path.join(os.fsencode(room / "I"), name))  # noqa: PTH104, PTH118

    return with_images(make)


OUTS: dict[str, tuple[str, Callable[[Path], None]]] = {  # directories of results that are refused
    "database.db of the user's": ("P", of_the_user("database.db")),
    "a journal of the user's": ("P", of_the_user("work/journal.sqlite")),
    "a mark that is none": ("P --fresh", of_the_user("work/results.json", "[]]")),
    "work links to the images": (
        "P",
        with_images(lambda room: [(room / "P").mkdir(), (room / "P" / "work").symlink_to("../I")]),
    ),
    "results in the images": ("I", with_images()),
    "results above the images": (".", with_images()),
    "results below a file": ("quick.toml/o", with_images()),
    "results below /proc": ("/proc/o", with_images()),
    "results in no name": ("''", with_images()),
    "results in 300 characters": (f"out/{'o' * 300}", with_images()),
    "results in a link to itself": ("P", with_images(lambda room: (room / "P").symlink_to("P"))),
    "results in a pipe": ("P", with_images(lambda room: os.mkfifo(room / "P"))),
}
NAMES: dict[str, tuple[bytes, tuple[int, ...]]] = {
    "Latin 1": (b"caf\xe9", REFUSED),
    "a line feed": (b"a\nb", REFUSED),
    "a line separator": ("a\u2028b".encode(), REFUSED),
    "hidden": (b".thumbnails", TAKEN),
    "an image's": (b"x.jpg", TAKEN),
    "blanks": (b" a  b ", TAKEN),
    "quotes": (b"a'b\"c,;", TAKEN),
    "a backslash": (b"a\\b", TAKEN),
    "a dash in front": (b"--out", TAKEN),
    "markup": (b"<script>x<", TAKEN),
    "other scripts": ("\u202e\U0001f600\u0430e\u0301".encode(), TAKEN),
    "250 characters": (b"n" * 250, TAKEN),
}
ALIKE: dict[str, tuple[Callable[[Path], object], tuple[int, ...]]] = {
    "two of one stem": (lambda folder: (folder / "0.jpg").write_bytes(encoded(".jpg")), REFUSED),
    "one in capitals": (lambda folder: (folder / "0.PNG").write_bytes(encoded(".png")), REFUSED),
    "a folder called as a result": (lambda folder: write_images(folder / "MODELS"), REFUSED),
    "an ending alone": (lambda folder: (folder / ".png").write_bytes(encoded(".png")), TAKEN),
    "links that go round": (lambda folder: (folder / "round").symlink_to("."), TAKEN),
    "folders 50 deep": (lambda folder: write_images(folder.joinpath(*"abcde" * 10)), TAKEN),
    "ids that meet": (
        lambda folder: [write_images(folder / name) for name in ("a_b", "a/b", "I", "a/b/c")],
        TAKEN,
    ),
}
IMAGES: dict[str, tuple[Callable[[Path], object], tuple[int, ...]]] = {
    **{
        f"jpg: {name}": (lambda folder, d=damage: (folder / "x.jpg").write_bytes(d(encoded(".jpg"))), TAKEN)
        for name, damage in DAMAGES.items()
    },
    **{
        name: (lambda folder, m=make, s=suffix: (folder / f"x{s}").write_bytes(m()), TAKEN)
        for name, (suffix, make) in ODD.items()
    },
    **{
        f"an image is {name}": (lambda folder, m=make: m(folder / "x.png"), EITHER)
        for name, make in PLACES.items()
    },
}
CHANGES: dict[str, Callable[[Path], object]] = {  # between two runs, below the folder out
    "an ending that was changed": lambda out: (out / "i/0.png").rename(out / "i/0.jpeg"),
    "an image that was changed": lambda out: (out / "i/0.png").write_bytes(encoded(".png", picture(50))),
    "an image that was removed": lambda out: (out / "i/0.png").unlink(),
    "a dataset more": lambda out: write_images(out / "i/more"),
    "no database": lambda out: (out / "o/database.db").unlink(missing_ok=True),
    "no journal": lambda out: (out / "o/work/journal.sqlite").unlink(),
    "a journal of noise": lambda out: (out / "o/work/journal.sqlite").write_bytes(os.urandom(9999)),
    "a database of noise": lambda out: (out / "o/database.db").write_bytes(os.urandom(9999)),
    "a file of the user's": lambda out: (out / "o/notes.txt").touch(),
    "another recipe": lambda out: (out / "quick.toml").write_text(RECIPE.replace("200", "190")),
}


def then(change: Callable[[Path], object]) -> tuple[Callable[[Path], None], Act]:
    """How to make the room, and how to change it after the first run."""
    rooms: list[Path] = []

    def make(room: Path) -> None:
        rooms.append(room)
        write_images(room / "out" / "i", 4)
        (room / "out" / "quick.toml").write_text(RECIPE)

    def act(process: "subprocess.Popen[bytes]") -> None:
        process.wait()
        change(rooms[-1] / "out")

    return make, act


def again(name: str) -> Case:
    make, act = then(CHANGES[name])
    return Case("folders", f"again: {name}", PLAIN, make, EITHER, act=act, then=PLAIN)


def inside(make: Callable[[Path], object]) -> Callable[[Path], None]:
    return with_images(lambda room: make(room / "I"))


TABLES = f"{WATCHED} --format imc2025"
CASES = [
    *(
        Case("folders", name, f"reconstruct I {OPTIONS} --out {out}", make, REFUSED)
        for name, (out, make) in OUTS.items()
    ),
    *(
        Case("folders", f"{what} name: {told}", TABLES, make(name), statuses)
        for what, make in (("an image's", image_named), ("a folder's", folder_named))
        for told, (name, statuses) in NAMES.items()
    ),
    *(Case("folders", name, TABLES, inside(make), statuses) for name, (make, statuses) in ALIKE.items()),
    *(
        Case("folders", name, f"{WATCHED} --rotations", inside(make), statuses)
        for name, (make, statuses) in IMAGES.items()
    ),
    *(
        Case("folders", f"a list: {path}", f"{WATCHED} --pairs {path}", with_images(), REFUSED)
        for path in (
            "nothing.txt",
            "I",
            "/dev/zero",
            "I/0.png",
        )
    ),
    *map(again, CHANGES),
    *(
        Case("folders", f"{name} after 4 s", PLAIN, then(nothing)[0], (1, *STATUSES[name]), act=sends(name, 4.0))
        for name in ENDS
    ),
]
