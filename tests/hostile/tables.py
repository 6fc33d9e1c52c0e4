"""``test.csv`` as nobody should write it."""

import gzip
import os
from pathlib import Path

from attack import EITHER, REFUSED, Case
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
    "an empty file": b"",
    "a header alone": HEADER.encode(),
    "no header": ROW.encode(),
    "a column missing": TABLE.replace("image_2_id", "image_3_id").encode(),
    "an id twice": (HEADER + ROW + ROW).encode(),
    "a batch above": (HEADER + "1,..,x,y\n").encode(),
    "a batch further above": (HEADER + "1,../../etc,x,y\n").encode(),
    "an absolute batch": (HEADER + "1,/etc,x,y\n").encode(),
    "an image id with a slash": (HEADER + "1,b1,a/x,y\n").encode(),
    "an image id with a backslash": (HEADER + "1,b1,a\\x,y\n").encode(),
    "an empty image id": (HEADER + "1,b1,,y\n").encode(),
    "an empty batch id": (HEADER + "1,,x,y\n").encode(),
    "rows with more cells": (HEADER + "1,b1,x,y,z\n").encode(),
    "UTF-16": TABLE.encode("utf-16"),
    "compressed": gzip.compress(TABLE.encode()),
    "bytes that are no UTF-8": TABLE.encode().replace(b"x-y", b"\xff\xfe"),
    "a drive's name": (HEADER + "1,C:b1,x,y\n").encode(),
    "a control character in an id": (HEADER + "a\x01b,b1,x,y\n").encode(),
    "a carriage return in an id": (HEADER + '"a\rb",b1,x,y\n').encode(),
    "a line feed in an id": (HEADER + '"a\nb",b1,x,y\n').encode(),
}
EITHERS = {
    "a byte order mark": b"\xef\xbb\xbf" + TABLE.encode(),
    "lines of another system": TABLE.replace("\n", "\r\n").encode(),
    "lines of an old system": TABLE.replace("\n", "\r").encode(),
    "NUL bytes": TABLE.encode().replace(b"x-y", b"x\0y"),
    "a column too many": TABLE.replace("\n", ",more\n").encode(),
    "a column twice": TABLE.replace("\n", ",x\n").replace("id,x", "id,sample_id", 1).encode(),
    "the columns in another order": b"image_2_id,image_1_id,batch_id,sample_id\ny,x,b1,1\n",
    "semicolons": TABLE.replace(";", "-").replace(",", ";").encode(),
    "blanks around cells": TABLE.replace(",", " , ").encode(),
    "an open quote": (HEADER + '"b1,b1,x,y\n').encode(),
    "quotes and commas in an id": (HEADER + '"a,""b""",b1,x,y\n').encode(),
    "ids like missing values": (HEADER + "nan,b1,x,y\nNA,b1,NA,null\n,b1,x,y\n").encode(),
    "ids like numbers": (HEADER + "001,b1,x,y\n1e3,b1,x,y\n1,b1,x,y\n").encode(),
    "ids of other scripts": (HEADER + "\u202eab\U0001f600\u0301,b1,x,y\n").encode(),
    "a formula": (HEADER + "=cmd|' /C calc'!A0,b1,x,y\n").encode(),
    "a very long sample id": (HEADER + "s" * 100_000 + ",b1,x,y\n").encode(),
    "a batch id of 5,000 characters": (HEADER + "1," + "b" * 5000 + ",x,y\n2,b1,x,y\n").encode(),
    "an image id of 300 characters": (HEADER + "1,b1," + "x" * 300 + ",y\n2,b1,x,y\n").encode(),
    "the same image twice": (HEADER + "1,b1,x,x\n").encode(),
    "images that are not there": (HEADER + "1,b1,x,q\n2,b1,x,y\n").encode(),
    "a batch that is not there": (HEADER + "1,b2,x,y\n2,b1,x,y\n").encode(),
    "a hidden batch": (HEADER + "1,.b,x,y\n2,b1,x,y\n").encode(),
    "a device's name": (HEADER + "1,CON,x,y\n2,b1,x,y\n").encode(),
    "an image id with a NUL": (HEADER + "1,b1,a\0,y\n2,b1,x,y\n").encode(),
    "blank lines": TABLE.replace("\n", "\n\n\n").encode(),
    "rows with fewer cells": (HEADER + "1,b1\n2,b1,x,y\n").encode(),
    "no last line feed": TABLE.rstrip().encode(),
    "a hundred thousand columns": (HEADER.strip() + ",c" * 100_000 + "\n" + ROW).encode(),
    "5,000 pairs of no images": (HEADER + "".join(f"{n},b1,p{n},q{n}\n" for n in range(5000))).encode(),
    "a cell of 10 MB": (HEADER + "1,b1,x,y\n2,b1,x," + "y" * 10_000_000 + "\n").encode(),
}
PLACES = {
    "a directory": Path.mkdir,
    "a pipe": os.mkfifo,
    "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "a link to /dev/null": lambda path: path.symlink_to("/dev/null"),
    "a link to itself": lambda path: path.symlink_to(path),
    "a link to nothing": lambda path: path.symlink_to("nothing"),
    "nothing at all": lambda path: None,
}
DIRECTORIES = {
    "a directory that is not there": "E",
    "a file for the directory": "D/test.csv",
    "no name for the directory": "''",
    "a very long name for the directory": "d" * 5000,
    "a NUL-like name for the directory": "'D%00'",
    "another directory": "out",
}

CASES = [
    Case(
        "tables",
        "a batch that the file system's encoding lacks",
        SUBMIT,
        written((HEADER + "1,\u00e9,x,y\n2,b1,x,y\n").encode()),
        EITHER,
        says="1 of 2 pairs",
        env={"LC_ALL": "C", "PYTHONUTF8": "0"},
    ),
    *(Case("tables", name, SUBMIT, written(data), REFUSED) for name, data in REFUSALS.items()),
    *(Case("tables", name, SUBMIT, written(data), EITHER) for name, data in EITHERS.items()),
    *(Case("tables", name, SUBMIT, in_place(make), REFUSED) for name, make in PLACES.items()),
    *(
        Case("tables", name, SUBMIT.replace("--test-dir D", f"--test-dir {place}"), statuses=REFUSED)
        for name, place in DIRECTORIES.items()
    ),
]
