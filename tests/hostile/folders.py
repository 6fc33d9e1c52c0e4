"""Folders of images to reconstruct: odd names, results in the way, commands given again after a
change.

tests/reconstruction has more.
"""

import os
from collections.abc import Callable
from pathlib import Path

from attack import EITHER, Case, Make, nothing
from ends import ENDS, STATUSES, sends
from room import (
    IMAGES_TO,
    RECIPE,
    RECONSTRUCT,
    encoded,
    makes,
    options,
    picture,
    resumed,
    write_images,
)

OUTS = {
    "in the images": "I",
    "above the images": ".",
    "below a file": "quick.toml/o",
    "below /proc": "/proc/o",
    "in no name": "''",
    "in 300 characters": f"out/{'o' * 300}",
}
# Names go into tables, databases, links, HTML and command lines.
GOOD_NAMES = {
    "an image's": b"x.jpg",
    "blanks": b" a  b ",
    "quotes": b"a'b\"c,;",
    "a backslash": b"a\\b",
    "markup": b"<script>x<",
    "other scripts": "\u202e\U0001f600\u0430e\u0301".encode(),
    "250 characters": b"n" * 250,
}
# A line of a table cannot hold them.
BAD_NAMES = {"Latin 1": b"caf\xe9", "a line feed": b"a\nb"}
ODD = {
    "two of one stem": lambda folder: (folder / "0.jpg").write_bytes(encoded(".jpg")),
    "a folder called as a result": lambda folder: write_images(folder / "MODELS"),
    "an ending alone": lambda folder: (folder / ".png").write_bytes(encoded(".png")),
    "links that go round": lambda folder: (folder / "round").symlink_to("."),
    "ids that meet": lambda folder: [
        write_images(folder / name) for name in ("a_b", "a/b", "I", "a/b/c")
    ],
}
JOURNAL = ("out", "o", "work", "journal.sqlite")
CHANGES = {  # between two runs
    "an image that was changed": lambda room: (room / "I/0.png").write_bytes(
        encoded(".png", picture(50))
    ),
    "an image that was removed": lambda room: (room / "I/0.png").unlink(),
    "a folder more": lambda room: write_images(room / "I/more"),
    "no database": lambda room: (room / "out/o/database.db").unlink(),
    "no journal": lambda room: room.joinpath(*JOURNAL).unlink(),
    "a journal of noise": lambda room: room.joinpath(*JOURNAL).write_bytes(os.urandom(9999)),
    "a database of noise": lambda room: (room / "out/o/database.db").write_bytes(
        os.urandom(9999)
    ),
    "a file of the user's": lambda room: (room / "out/o/notes.txt").touch(),
    "another recipe": lambda room: (room / "quick.toml").write_text(
        RECIPE.replace("200", "190")
    ),
}


def below(name: str, table: dict[str, Callable[[Path], object]]) -> dict[str, Make]:
    """Return changes of the room from changes of a path in it."""
    return {what: lambda room, m=make: m(room / name) for what, make in table.items()}


def names(table: dict[str, bytes]) -> dict[str, Make]:
    """Return changes that add an image, or a folder of images, of each name, which may be no text."""

    def add(room, name, is_folder):
        write_images(room / "J")
        (room / "J.png").write_bytes(encoded(".png", picture(40)))
        made = "J" if is_folder else "J.png"
        path = os.path.join(os.fsencode(room / "I"), name + made[1:].encode())  # noqa: PTH118
        os.rename(room / made, path)  # noqa: PTH104

    return {
        f"{what} name: {told}": lambda room, n=name, f=is_folder: add(room, n, f)
        for what, is_folder in (("an image's", False), ("a folder's", True))
        for told, name in table.items()
    }


CASES = [
    *options("folders", IMAGES_TO, {f"results {where}": out for where, out in OUTS.items()}),
    *makes("folders", RECONSTRUCT, names(BAD_NAMES)),
    *makes("folders", RECONSTRUCT, names(GOOD_NAMES), (0,)),
    *makes("folders", RECONSTRUCT, below("I", ODD), (0,)),
    *makes(
        "folders",
        RECONSTRUCT,
        {f"again: {name}": resumed(make) for name, make in CHANGES.items()},
        EITHER,
    ),
    *(
        Case(
            "folders",
            f"{n} after 4 s",
            RECONSTRUCT,
            nothing,
            (1, *STATUSES[n]),
            act=sends(n, 4.0),
        )
        for n in ENDS
    ),
]
