"""EXIF put into the bytes of JPEG and PNG files."""

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

SHORT, LONG, RATIONAL, TEXT = 3, 4, 5, 2
FOCAL_35MM = 0xA405

Value = int | str | tuple[int, int]  # a pair is a fraction


def set_exif(path: Path, orientation: int | None = None, *, order: str = "<", **tags: Value) -> Path:
    """Write EXIF into a JPEG or PNG file: an orientation, and tags of the EXIF directory such as ``tA405=28``."""
    main = {} if orientation is None else {0x0112: orientation}
    data = path.read_bytes()
    path.write_bytes(with_tiff(data, tiff(main, {int(tag[1:], 16): value for tag, value in tags.items()}, order)))
    return path


def tiff(main: Mapping[int, Value], exif: Mapping[int, Value], order: str = "<") -> bytes:
    """The tags of the first directory, and of the EXIF directory after it."""
    first = directory({**main, 0x8769: 0}, 8, order)
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}I", 8)
    return head + directory({**main, 0x8769: 8 + len(first)}, 8, order) + directory(exif, 8 + len(first), order)


def directory(tags: Mapping[int, Value], start: int, order: str) -> bytes:
    entries, after = struct.pack(f"{order}H", len(tags)), b""
    beyond = start + 2 + 12 * len(tags) + 4
    for tag, value in sorted(tags.items()):
        kind, count, data = SHORT, 1, b""
        if isinstance(value, str):
            kind, data = TEXT, value.encode() + b"\0"
            count = len(data)
        elif isinstance(value, tuple):
            kind, data = RATIONAL, struct.pack(f"{order}II", *value)
        elif tag == 0x8769:
            kind, data = LONG, struct.pack(f"{order}I", value)
        else:
            data = struct.pack(f"{order}H", value)
        if len(data) > 4:
            data, after = struct.pack(f"{order}I", beyond + len(after)), after + data
        entries += struct.pack(f"{order}HHI", tag, kind, count) + data.ljust(4, b"\0")
    return entries + bytes(4) + after


def with_tiff(data: bytes, part: bytes) -> bytes:
    """The bytes of a JPEG or PNG file with these tags."""
    if data[:2] == b"\xff\xd8":
        return data[:2] + b"\xff\xe1" + struct.pack(">H", len(part) + 8) + b"Exif\0\0" + part + data[2:]
    chunk = struct.pack(">I", len(part)) + b"eXIf" + part + struct.pack(">I", zlib.crc32(b"eXIf" + part))
    return data[:33] + chunk + data[33:]  # after the header
