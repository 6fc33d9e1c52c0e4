"""A stderr that is full and not read, and photographs that native decoders complain of there."""

import fcntl
import os
import zlib
from collections.abc import Callable
from pathlib import Path

from attack import Case, prepared
from images import chunk
from room import SUBMIT, encoded, picture

HEAD = 33  # bytes of a PNG's signature and first chunk
COMPLAINTS: dict[str, Callable[[int], bytes]] = {
    "a colour profile that is too short": lambda n: with_chunk(b"iCCP", b"x\0\0" + zlib.compress(b"bad"), n),
    "bytes between a photograph's restarts": lambda n: jpeg_with(b"\xff\xd0", n),
}
JOURNAL, FOLDER = "journal out/s.work --report out/r.html --test-dir D", "D/test_images/b1"
COMMANDS = {
    "submit in its own process": SUBMIT,
    "submit in a worker": SUBMIT.replace("--workers 0", "--workers 1"),
    "submit with a report": SUBMIT.replace(" --no-report", ""),
    "reconstruct": f"reconstruct {FOLDER} --recipe quick.toml --workers 1 --time-limit 5m --out out/o",
    "match": f"match {FOLDER}/x.png {FOLDER}/y.png --recipe quick.toml --out out/p.png",
    "a page from a journal": JOURNAL,
}


def with_chunk(kind: bytes, data: bytes, number: int) -> bytes:
    whole = encoded(".png", picture(12 * number))
    return whole[:HEAD] + chunk(kind, data) + whole[HEAD:]


def jpeg_with(data: bytes, number: int) -> bytes:
    whole = encoded(".jpg", picture(12 * number))
    return whole[: len(whole) // 2] + data + whole[len(whole) // 2 :]


def complained_of(make: Callable[[int], bytes], command: str) -> Callable[[Path], None]:
    def write(room: Path) -> None:
        for number, name in enumerate("xyz"):
            (room / FOLDER / f"{name}.png").write_bytes(make(number))
        if command == JOURNAL:
            prepared(SUBMIT, room)

    return write


def full_pipe() -> int:
    """Return the write end of a pipe that is full; the other end stays open, and is not read."""
    _, pipe = os.pipe()
    fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, 4096)
    os.write(pipe, bytes(4096))
    return pipe


CASES = [
    Case("unread", f"{name}: {complaint}", command, complained_of(make, command), (0, 1), stderr=full_pipe)
    for complaint, make in COMPLAINTS.items()
    for name, command in COMMANDS.items()
]
