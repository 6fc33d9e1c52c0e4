"""Folders of images to reconstruct: odd names and images, results in the way, lists of pairs, runs given again."""

import os
import shutil
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
WORK = Path("o", "work")  # of the results, in the folder of outputs
TAKEN = (0, 1)  # three small images need not give a model


def write_images(folder: Path, count: int = 3) -> None:
    folder.mkdir(parents=True)
    for number in range(count):
        (folder / f"{number}.png").write_bytes(encoded(".png", picture(8 * number)))


def images(room: Path) -> None:
    write_images(room / "I")


# Results in the way: P is the user's own.

USERS = (
    *(
        "database.db",
        "cameras.csv",
        "submission.csv",
        "report.html",
        "models/0/images.bin",
        "sparse/0/cameras.bin",
    ),
    *("database.db-wal", "work/journal.sqlite", "work/journal.lock", "images/0/1.png", "a/models/0/cameras.bin"),
    *("notes.txt", "a/b/c/d.txt", "models", "work", "results.json", "dense/fused.ply", "0/database.db"),
)
MARKS = ("", "[]]", "null", '"a"', "\0" * 100)


def of_the_user(name: str, text: str = "mine") -> Callable[[Path], None]:
    def make(room: Path) -> None:
        images(room)
        path = room / "P" / name
        path.parent.mkdir(parents=True)
        path.write_text(text)

    return make


def damaged_mark(text: str) -> Callable[[Path], None]:
    def make(room: Path) -> None:
        of_the_user("work/results.json", text)(room)
        (room / "P" / "database.db").write_text("mine")

    return make


LINKS = {
    "work": "../D",
    "models": "../D/test_images",
    "database.db": "../D/test.csv",
    "cameras.csv": "../D/test.csv",
    "submission.csv": "/dev/zero",
    "report.html": "nothing",
    "a": "../I",
    "round": "round",
}


def linked(name: str, target: str) -> Callable[[Path], None]:
    def make(room: Path) -> None:
        images(room)
        (room / "P").mkdir()
        (room / "P" / name).symlink_to(target)

    return make


OUTS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "the images": ("I", nothing),
    "a folder of the images": ("I/out", nothing),
    "the folder above the images": (".", nothing),
    "an image": ("I/0.png", nothing),
    "the recipe": ("quick.toml", nothing),
    "below a file": ("quick.toml/o", nothing),
    "the null device": ("/dev/null", nothing),
    "below /proc": ("/proc/o", nothing),
    "no name": ("''", nothing),
    "the root": ("/", nothing),
    "300 characters": (f"out/{'o' * 300}", nothing),
    "5,000 characters": ("/".join(["out", *["o" * 99] * 50]), nothing),
    "a link to the images": ("P", lambda room: (room / "P").symlink_to("I")),
    "a link to nothing": ("P", lambda room: (room / "P").symlink_to("nothing")),
    "a link to itself": ("P", lambda room: (room / "P").symlink_to("P")),
    "a pipe": ("P", lambda room: os.mkfifo(room / "P")),
}


def with_images(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def whole(room: Path) -> None:
        images(room)
        make(room)

    return whole


# Names: beside three plain images, or as their folder.

NAMES: dict[str, tuple[bytes, tuple[int, ...]]] = {
    "Latin 1": (b"caf\xe9", REFUSED),
    "half a character": (b"\xf0\x9f\x98", REFUSED),
    "a line feed": (b"a\nb", REFUSED),
    "a carriage return": (b"a\rb", REFUSED),
    "an escape": (b"\x1b[2J", REFUSED),
    "a next line": ("a\x85b".encode(), REFUSED),
    "a line separator": ("a\u2028b".encode(), REFUSED),
    "hidden": (b".thumbnails", TAKEN),
    "of macOS": (b"._f0", TAKEN),
    "an image's": (b"x.jpg", TAKEN),
    "blanks": (b" a  b ", TAKEN),
    "quotes": (b"a'b\"c", TAKEN),
    "a comma": (b"a,b", TAKEN),
    "a semicolon": (b"a;b", TAKEN),
    "a backslash": (b"a\\b", TAKEN),
    "a dash in front": (b"--out", TAKEN),
    "a per cent sign": (b"%s%n", TAKEN),
    "braces": (b"{0}{x}", TAKEN),
    "markup": (b"<script>x<", TAKEN),
    "a star": (b"*[a-z]?", TAKEN),
    "a device's": (b"CON", TAKEN),
    "two dots": (b"..a..", TAKEN),
    "other scripts": ("\u202e\U0001f600\u0430".encode(), TAKEN),
    "two forms of a letter": ("e\u0301".encode(), TAKEN),
    "250 characters": (b"n" * 250, TAKEN),
}
FOLDERS = ("models", "work", "database.db", "cameras.csv", "submission.csv", "report.html", "MODELS", "a/models")


def named(name: bytes) -> Callable[[Path], None]:
    def make(room: Path) -> None:
        images(room)
        with open(os.path.join(os.fsencode(room / "I"), name + b".png"), "wb") as stream:  # noqa: PTH118, PTH123
            stream.write(encoded(".png", picture(30)))

    return make


def in_folder(name: bytes) -> Callable[[Path], None]:
    def make(room: Path) -> None:
        images(room)
        write_images(room / "J")
        target = os.path.join(os.fsencode(room / "I"), name)  # noqa: PTH118
        os.makedirs(os.path.dirname(target), exist_ok=True)  # noqa: PTH103, PTH120
        os.rename(room / "J", target)  # noqa: PTH104

    return make


ALIKE: dict[str, tuple[Callable[[Path], object], tuple[int, ...]]] = {
    "two of one stem": (lambda folder: (folder / "0.jpg").write_bytes(encoded(".jpg")), REFUSED),
    "one in capitals": (lambda folder: (folder / "0.PNG").write_bytes(encoded(".png")), REFUSED),
    "an ending alone": (lambda folder: (folder / ".png").write_bytes(encoded(".png")), TAKEN),
    "a folder with an image's name": (lambda folder: write_images(folder / "x.jpg"), TAKEN),
    "links that go round": (lambda folder: (folder / "round").symlink_to("."), TAKEN),
    "a link to itself": (lambda folder: (folder / "x.png").symlink_to("x.png"), TAKEN),
    "folders 50 deep": (lambda folder: write_images(folder.joinpath(*"abcde" * 10)), TAKEN),
    "ids that meet": (
        lambda folder: [write_images(folder / name) for name in ("a_b", "a/b", "I", "a/b/c")],
        TAKEN,
    ),
    "an image many times": (
        lambda folder: [(folder / f"{number}.jpg").write_bytes(encoded(".jpg")) for number in range(3, 7)],
        TAKEN,
    ),
}


# Lists of pairs.

LISTS: dict[str, bytes] = {
    "nothing": b"",
    "blanks": b" \n\t\n",
    "one name": b"0.png\n",
    "three names": b"0.png 1.png 2.png\n",
    "an image twice": b"0.png 0.png\n",
    "an image that is not there": b"0.png 9.png\n",
    "a way round": b"0.png ../I/1.png\n",
    "absolute paths": b"/0.png /1.png\n",
    "zeros": b"0.png\0 1.png\n",
    "noise": bytes(range(256)) * 20,
    "Latin 1": b"caf\xe9.png 0.png\n",
    "UTF-16": "0.png 1.png\n".encode("utf-16"),
    "a line of a megabyte": b"a " * 500_000,
    "a header": b"image0 image1\n0.png 1.png\n",
    "commas": b"0.png,1.png\n",
}


def listed(data: bytes) -> Callable[[Path], None]:
    def make(room: Path) -> None:
        images(room)
        (room / "pairs.txt").write_bytes(data)

    return make


# Runs that are given again after something has changed.


def then(change: Callable[[Path], object]) -> tuple[Callable[[Path], None], Act]:
    """How the room is made, and what is changed in it when the first run has ended."""
    rooms: list[Path] = []

    def make(room: Path) -> None:
        rooms.append(room)
        write_images(room / "out" / "i", 4)
        (room / "out" / "quick.toml").write_text(RECIPE)

    def act(process: "subprocess.Popen[bytes]") -> None:
        process.wait()
        change(rooms[-1] / "out")

    return make, act


def replaced_by_link(path: Path) -> None:
    path.rename(path.with_name("former"))
    path.symlink_to("former")


CHANGES: dict[str, Callable[[Path], object]] = {
    "an ending that was changed": lambda out: (out / "i/0.png").rename(out / "i/0.jpeg"),
    "an image that was changed": lambda out: (out / "i/0.png").write_bytes(encoded(".png", picture(50))),
    "an image that was emptied": lambda out: (out / "i/0.png").write_bytes(b""),
    "an image that was removed": lambda out: (out / "i/0.png").unlink(),
    "an image more": lambda out: (out / "i/7.png").write_bytes(encoded(".png", picture(50))),
    "a dataset more": lambda out: write_images(out / "i/more"),
    "images that moved": lambda out: (out / "i").rename(out / "k") and (out / "k").rename(out / "i"),
    "no database": lambda out: (out / "o/database.db").unlink(missing_ok=True),
    "no models": lambda out: shutil.rmtree(out / "o/models", ignore_errors=True),
    "no tables": lambda out: (out / "o/cameras.csv").unlink(),
    "no journal": lambda out: (out / WORK / "journal.sqlite").unlink(),
    "no mark": lambda out: (out / WORK / "results.json").unlink(),
    "a mark of noise": lambda out: (out / WORK / "results.json").write_bytes(os.urandom(99)),
    "a journal of noise": lambda out: (out / WORK / "journal.sqlite").write_bytes(os.urandom(9999)),
    "no journal of the images": lambda out: shutil.rmtree(out / WORK / "images"),
    "a journal of the images of noise": lambda out: (out / WORK / "images/journal.sqlite").write_bytes(
        os.urandom(9999)
    ),
    "a database of noise": lambda out: (out / "o/database.db").write_bytes(os.urandom(9999)),
    "a link for work": lambda out: replaced_by_link(out / WORK),
    "a link for the tables": lambda out: replaced_by_link(out / "o/cameras.csv"),
    "a folder for the tables": lambda out: [(out / "o/cameras.csv").unlink(), (out / "o/cameras.csv").mkdir()],
    "a file of the user's": lambda out: (out / "o/notes.txt").touch(),
    "another recipe": lambda out: (out / "quick.toml").write_text(RECIPE.replace("200", "190")),
}


def again(name: str, options: str = "") -> Case:
    make, act = then(CHANGES[name])
    told = f"{name}, {options.strip()}" if options else name
    return Case("folders", f"again: {told}", PLAIN, make, EITHER, act=act, then=PLAIN + options)


def interrupted(name: str, after: float, options: str) -> Case:
    command = PLAIN.replace("out/quick.toml", "classical") + options
    act = sends(name, after)
    made = then(nothing)[0]
    return Case(
        "folders",
        f"{name} after {after} s{options}",
        command,
        made,
        (1, *STATUSES[name]),
        act=act,
        then=PLAIN_AGAIN,
    )


PLAIN_AGAIN = PLAIN.replace("out/quick.toml", "classical") + " --rotations --fresh"
REJECTED = (
    *("--format foo", "--format ''", "--time-limit 0", "--time-limit nan", "--workers -1", "--device foo"),
    *("--recipe foo", "--recipe ''", "--recipe I", "--pairs nothing.txt", "--pairs I", "--pairs /dev/zero"),
    *("--pairs I/0.png", "--weights foo", "--precision int8", "--mode foo", "--started-at nan"),
)

CASES = [
    *(
        Case(
            "folders",
            f"{name} of the user's",
            f"reconstruct I {OPTIONS} --out P",
            of_the_user(name),
            REFUSED,
            "way",
        )
        for name in USERS
    ),
    *(
        Case(
            "folders",
            f"a mark {text[:9]!r}",
            f"reconstruct I {OPTIONS} --out P --fresh",
            damaged_mark(text),
            REFUSED,
        )
        for text in MARKS
    ),
    *(
        Case(
            "folders",
            f"{name} links to {to}",
            f"reconstruct I {OPTIONS} --out P",
            linked(name, to),
            REFUSED,
            "way",
        )
        for name, to in LINKS.items()
    ),
    *(
        Case("folders", f"results in {name}", f"reconstruct I {OPTIONS} --out {out}", with_images(make), REFUSED)
        for name, (out, make) in OUTS.items()
    ),
    *(
        Case("folders", f"an image's name: {told}", f"{WATCHED} --format imc2025", named(name), statuses)
        for told, (name, statuses) in NAMES.items()
    ),
    *(
        Case("folders", f"a folder's name: {told}", f"{WATCHED} --format imc2025", in_folder(name), statuses)
        for told, (name, statuses) in list(NAMES.items())[:12]
    ),
    *(
        Case("folders", f"a folder {name}", WATCHED, in_folder(name.encode()), REFUSED, "rename")
        for name in FOLDERS
    ),
    *(
        Case(
            "folders",
            name,
            f"{WATCHED} --format imc2025",
            with_images(lambda room, m=make: m(room / "I")),
            statuses,
        )
        for name, (make, statuses) in ALIKE.items()
    ),
    *(
        Case("folders", f"a list of {name}", f"{WATCHED} --pairs pairs.txt", listed(data), REFUSED)
        for name, data in LISTS.items()
    ),
    *(Case("folders", f"option {option}", f"{WATCHED} {option}", images, REFUSED) for option in REJECTED),
    *(
        Case(
            "folders",
            f"jpg: {name}",
            f"{WATCHED} --rotations",
            with_images(lambda room, d=damage: (room / "I" / "x.jpg").write_bytes(d(encoded(".jpg")))),
            TAKEN,
        )
        for name, damage in DAMAGES.items()
    ),
    *(
        Case(
            "folders",
            name,
            f"{WATCHED} --rotations",
            with_images(lambda room, m=make, s=suffix: (room / "I" / f"x{s}").write_bytes(m())),
            TAKEN,
        )
        for name, (suffix, make) in list(ODD.items())[:8]
    ),
    *(
        Case(
            "folders",
            f"an image is {name}",
            f"{WATCHED} --rotations",
            with_images(lambda room, m=make: m(room / "I" / "x.png")),
            EITHER,
        )
        for name, make in PLACES.items()
    ),
    *(again(name) for name in CHANGES),
    *(again(name, " --fresh --format imc2023") for name in list(CHANGES)[:6]),
    *(
        interrupted(name, after, options)
        for name in ENDS
        for after in (1.0, 4.0, 8.0)
        for options in ("", " --rotations")
    ),
]
