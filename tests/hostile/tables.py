"""``test.csv`` as nobody should write it."""

import os
from pathlib import Path

from attack import REFUSED, Case
from room import HEADER, SUBMIT, TABLE

ROW = "b1;x-y,b1,x,y\n"


def written(data: bytes):
    return lambda room: (room / "D" / "test.csv").write_bytes(data)


def in_place(make):
    """Something else than a file."""

    def replace(room: Path) -> None:
        path = room / "D" / "test.csv"
        path.unlink()
        make(path)

    return replace


REFUSALS = {
    "a batch further above": (HEADER + "1,../../etc,x,y\n").encode(),
    "UTF-16": TABLE.encode("utf-16"),
    "bytes that are not UTF-8": TABLE.encode().replace(b"x-y", b"\xff\xfe"),
    "a hundred thousand columns": (HEADER.strip() + ",c" * 100_000 + "\n" + ROW).encode(),
    "a cell of 10 MB": (HEADER + "1,b1,x,y\n2,b1,x," + "y" * 10_000_000 + "\n").encode(),
}
TAKEN = {
    "a byte order mark": b"\xef\xbb\xbf" + TABLE.encode(),
    "lines of another system": TABLE.replace("\n", "\r\n").encode(),
    "a very long sample id": (HEADER + "s" * 100_000 + ",b1,x,y\n").encode(),
    "a batch id of 5,000 characters": (HEADER + "1," + "b" * 5000 + ",x,y\n2,b1,x,y\n").encode(),
}
NO_IMAGES = (HEADER + "".join(f"{n},b1,p{n},q{n}\n" for n in range(5000))).encode()
PLACES = {
    "a directory": Path.mkdir,
    "a pipe": os.mkfifo,
    "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
}
CASES = [
    Case(
        "tables",
        "a batch that the file system's encoding lacks",
        SUBMIT,
        written((HEADER + "1,\u00e9,x,y\n2,b1,x,y\n").encode()),
        says="1 of 2 pairs",
        env={"LC_ALL": "C", "PYTHONUTF8": "0"},
    ),
    *(Case("tables", name, SUBMIT, written(data), REFUSED) for name, data in REFUSALS.items()),
    *(Case("tables", name, SUBMIT, written(data)) for name, data in TAKEN.items()),
    Case("tables", "5,000 pairs of no images", SUBMIT, written(NO_IMAGES), statuses=(1,)),
    *(Case("tables", name, SUBMIT, in_place(make), REFUSED) for name, make in PLACES.items()),
    Case(
        "tables", "a very long name", SUBMIT.replace("--test-dir D", f"--test-dir {'d' * 5000}"), statuses=REFUSED
    ),
]
