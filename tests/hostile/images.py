"""Images that cannot be read, or are too much: the other pair must still have its F."""

import struct
import zlib
from collections.abc import Callable

import cv2
from attack import Make
from room import RECONSTRUCT, REPORTED, SUBMIT, encoded, makes, picture, replaced

DAMAGES = {
    "its first half": lambda data: data[: len(data) // 2],
    "bytes after its end": lambda data: data + b"\0" * 10_000,
    "zeros for its middle": lambda data: data[:200] + bytes(len(data) - 400) + data[-200:],
    "bits turned in the middle": lambda data: (
        data[:500] + bytes(255 - b for b in data[500:600]) + data[600:]
    ),
    # The head of a PNG has both sides as numbers of four bytes; a JPEG stays as it is.
    "another size in its head": lambda data: data.replace(
        struct.pack(">I", 160), struct.pack(">I", 60_000), 2
    ),
    "text": lambda _: b"this is no image\n" * 100,
}


def chunk(kind: bytes, data: bytes) -> bytes:
    return (
        struct.pack(">I", len(data))
        + kind
        + data
        + struct.pack(">I", zlib.crc32(kind + data))
    )


def png(width: int, height: int, *chunks: bytes, depth: int = 8) -> bytes:
    """Return a PNG that claims that size; without chunks it has a byte of pixels."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, 0))
    body = b"".join(chunks) or chunk(b"IDAT", zlib.compress(b"\0"))
    return b"\x89PNG\r\n\x1a\n" + head + body + chunk(b"IEND", b"")


def rows(width: int, height: int, depth: int = 8) -> bytes:
    # Black; each row begins with a byte for its filter.
    return chunk(b"IDAT", zlib.compress(bytes((1 + (width * depth + 7) // 8) * height)))


# A decoder that believes the head of a file allocates the size that it claims.
ODD = {
    "2^31 - 1 pixels a side": lambda: png(2**31 - 1, 2**31 - 1),
    "20,000 black pixels a side": lambda: png(
        20_000, 20_000, rows(20_000, 20_000, 1), depth=1
    ),
    "1 x 60,000 pixels": lambda: encoded(".jpg", cv2.resize(picture(0), (1, 60_000))),
    "a tag of no end": lambda: (
        encoded(".jpg")[:2] + b"\xff\xe1\xff\xffExif\0\0II*\0\x08\0\0\0" + b"\xff" * 50_000
    ),
    "a text of 200 MB": lambda: png(
        9, 9, chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(2 * 10**8))), rows(9, 9)
    ),
}


def at(name: str, make: Callable[[], bytes]) -> Make:
    return replaced(name, lambda path: path.write_bytes(make()))


X = "D/test_images/b1/x.png"
DAMAGED = {
    f"{suffix[1:]}: {name}": at(X, lambda d=damage, s=suffix: d(encoded(s)))
    for name, damage in DAMAGES.items()
    for suffix in (".png", ".jpg")
}
CASES = [
    *makes("images", SUBMIT, DAMAGED, (0,), says="pairs with an F"),
    *makes("images", REPORTED, {name: at(X, make) for name, make in ODD.items()}, (0,)),
    *makes(
        "images",
        RECONSTRUCT,
        {f"{name}, a folder": at("I/0.png", make) for name, make in ODD.items()},
        (0, 1),
    ),
]
