"""Images that cannot be read, or are too much: the other pair must still have its F."""

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from attack import Case
from room import SUBMIT, encoded, picture

KINDS = (".png", ".jpg")
DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "its first half": lambda data: data[: len(data) // 2],
    "its second half": lambda data: data[len(data) // 2 :],
    "bytes after its end": lambda data: data + b"\0" * 10_000,
    "zeros for its middle": lambda data: data[:200] + bytes(len(data) - 400) + data[-200:],
    "bits turned in the middle": lambda data: (
        data[:500] + bytes(255 - byte for byte in data[500:600]) + data[600:]
    ),
    "another size in its head": lambda data: data.replace(struct.pack(">I", 160), struct.pack(">I", 60_000), 2),
    "text": lambda data: b"this is no image\n" * 100,
    "noise": lambda data: np.random.default_rng(1).bytes(5000),
}


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, *chunks: bytes, depth: int = 8, colour: int = 0) -> bytes:
    """A PNG that claims that size; without chunks it has a byte of pixels."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    body = b"".join(chunks) or chunk(b"IDAT", zlib.compress(b"\0"))
    return b"\x89PNG\r\n\x1a\n" + head + body + chunk(b"IEND", b"")


def rows(width: int, height: int, depth: int = 8) -> bytes:
    return chunk(b"IDAT", zlib.compress(bytes((1 + (width * depth + 7) // 8) * height)))


ODD: dict[str, tuple[str, Callable[[], bytes]]] = {
    "2^31 - 1 pixels a side": (".png", lambda: png(2**31 - 1, 2**31 - 1)),
    "20,000 black pixels a side": (".png", lambda: png(20_000, 20_000, rows(20_000, 20_000, 1), depth=1)),
    "1 x 60,000 pixels": (".jpg", lambda: encoded(".jpg", cv2.resize(picture(0), (1, 60_000)))),
    "a tag of no end": (
        ".jpg",
        lambda: encoded(".jpg")[:2] + b"\xff\xe1\xff\xffExif\0\0II*\0\x08\0\0\0" + b"\xff" * 50_000,
    ),
    "a text of 200 MB in a PNG": (
        ".png",
        lambda: png(64, 64, chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(200_000_000))), rows(64, 64)),
    ),
    "an HDR image by another name": (".png", lambda: encoded(".hdr", picture(0).astype(np.float32) * 1e30)),
}


PLACES: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "a link to nothing": lambda path: path.symlink_to("nothing"),
    "a link to another image": lambda path: path.symlink_to(path.with_name("z.png")),
    "a name in another case": lambda path: path.with_name("X.PNG").write_bytes(encoded(".png")),
}


def instead_of_x(suffix: str, make: Callable[[Path], object]) -> Callable[[Path], None]:
    def replace(room: Path) -> None:
        images = room / "D" / "test_images" / "b1"
        (images / "x.png").unlink()
        make(images / f"x{suffix}")

    return replace


def damaged(suffix: str, damage: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    return instead_of_x(suffix, lambda path: path.write_bytes(damage(encoded(suffix))))


REPORTED = SUBMIT.replace(" --no-report", "")
CASES = [
    *(
        Case("images", f"{suffix[1:]}: {name}", SUBMIT, damaged(suffix, damage), says="pairs have an F")
        for name, damage in DAMAGES.items()
        for suffix in KINDS
    ),
    *(
        Case("images", name, REPORTED, instead_of_x(suffix, lambda path, m=make: path.write_bytes(m())))
        for name, (suffix, make) in ODD.items()
    ),
    *(Case("images", name, REPORTED, instead_of_x(".png", make)) for name, make in PLACES.items()),
]
