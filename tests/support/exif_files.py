"""EXIF put into the bytes of JPEG and PNG files."""

import struct
import zlib
from pathlib import Path

import PIL.Image
from PIL.TiffImagePlugin import IFDRational

Value = int | str | tuple[int, int]  # a pair is a fraction


def set_exif(
    path: Path, orientation: int | None = None, *, order: str = "<", **tags: Value
) -> Path:
    """Write EXIF into a JPEG or PNG file: an orientation, and tags of the EXIF directory such as
    ``tA405=28``.
    """
    path.write_bytes(with_tiff(path.read_bytes(), tiff(orientation, order, **tags)))
    return path


def tiff(orientation: int | None = None, order: str = "<", **tags: Value) -> bytes:
    """Return the tags in TIFF's format, in that byte order."""
    exif = PIL.Image.Exif()
    exif.endian = order
    if orientation is not None:
        exif[0x0112] = orientation
    directory: dict[int, object] = {}
    for tag, value in tags.items():
        # Pillow would write a pair of integers as two numbers, and not as a fraction.
        stored = IFDRational(*value) if isinstance(value, tuple) else value
        directory[int(tag[1:], 16)] = stored
    exif[0x8769] = directory
    return exif.tobytes().removeprefix(b"Exif\0\0")


def with_tiff(data: bytes, part: bytes) -> bytes:
    """Return the bytes of a JPEG or PNG file with these tags."""
    if data[:2] == b"\xff\xd8":
        # The length of a segment counts its own two bytes and the six of the name.
        length = struct.pack(">H", len(part) + 8)
        return data[:2] + b"\xff\xe1" + length + b"Exif\0\0" + part + data[2:]
    length = struct.pack(">I", len(part))
    checksum = struct.pack(">I", zlib.crc32(b"eXIf" + part))
    chunk = length + b"eXIf" + part + checksum
    return data[:33] + chunk + data[33:]  # after the header
