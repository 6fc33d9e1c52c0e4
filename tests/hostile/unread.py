"""A stderr that is full and not read, and photographs that native decoders complain of there."""

import fcntl
import os
import zlib
from collections.abc import Callable
from pathlib import Path

from attack import Case, Make
from images import chunk
from room import IMAGES_TO, REPORTED, SUBMIT, encoded, picture

HEAD = 33  # bytes of a PNG's signature and first chunk
FOLDER = "D/test_images/b1"
# A blocked terminal costs lines, not the run: the submission and the status are checked.
COMMANDS = {  # and a line that is not lost
    "submit in its own process": (SUBMIT, ""),
    "submit in a worker": (SUBMIT.replace("--workers 0", "--workers 1"), ""),
    "submit with a report": (REPORTED, ""),
    "reconstruct": (
        f"{IMAGES_TO} out/o".replace("I", FOLDER, 1).replace("rs 0", "rs 1"),
        "",
    ),
    "match": (
        f"match {FOLDER}/x.png {FOLDER}/y.png --recipe quick.toml --out out/p.png",
        "figure: out/p.png",
    ),
}


def short_profile(number: int) -> bytes:
    whole = encoded(".png", picture(12 * number))
    return whole[:HEAD] + chunk(b"iCCP", b"x\0\0" + zlib.compress(b"bad")) + whole[HEAD:]


def extra_restart(number: int) -> bytes:
    whole = encoded(".jpg", picture(12 * number))
    return whole[: len(whole) // 2] + b"\xff\xd0" + whole[len(whole) // 2 :]


def complained_of(make: Callable[[int], bytes]) -> Make:
    def write(room: Path) -> None:
        for number, name in enumerate("xyz"):
            (room / FOLDER / f"{name}.png").write_bytes(make(number))

    return write


def full_pipe() -> int:
    """Return the write end of a pipe that is full; the other end stays open, and is not read."""
    # 4096 bytes are the smallest pipe; the default holds all complaints of a run.
    _, pipe = os.pipe()
    fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, 4096)
    os.write(pipe, bytes(4096))
    return pipe


# libpng and libjpeg print to descriptor 2 themselves, past Python.
COMPLAINTS = {
    "a short colour profile": short_profile,
    "bytes between a photograph's restarts": extra_restart,
}
CASES = [
    Case(
        "unread",
        f"{name}: {complaint}",
        command,
        complained_of(make),
        (0, 1),
        says,
        submission=name.startswith("submit"),
        stderr=full_pipe,
    )
    for complaint, make in COMPLAINTS.items()
    for name, (command, says) in COMMANDS.items()
]
