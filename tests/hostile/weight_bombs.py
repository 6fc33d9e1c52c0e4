"""Weight files that would run code, take all memory, or hold no tensors; and directories with them."""

import io
import os
import pickle
import pickletools
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from attack import REFUSED, Case
from room import SUBMIT

CONVERT = "weights convert a.pt --out out/a.safetensors"
LENGTH = (6 * 10**9).to_bytes(8, "little")
PICKLES = {
    "lists of lists": b"\x80\x02" + b"]" * 500_000 + b"a" * 499_999 + b".",
    "a bytearray of 6 GB": b"\x80\x02cbuiltins\nbytearray\n\x8a\x08" + LENGTH + b"\x85R.",
    "a string of 4 GB": b"\x80\x02}X\xff\xff\xff\xffa.",
    "a million sets": b"\x80\x04(" + b"\x8f" * 1_000_000 + b"t.",
    "a tensor of 6 GB": b"\x80\x02ctorch\nFloatTensor\n\x8a\x08" + LENGTH + b"\x85R.",
    "a call of the system": b"\x80\x02cposix\nsystem\nX\x10\x00\x00\x00touch out/called\x85R.",
}


def unpacked(path: Path) -> None:
    (path / "data").mkdir(parents=True)
    (path / "data.pkl").write_bytes(pickle.dumps({}, protocol=2))
    os.mkfifo(path / "data" / "0")


FILES: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "an archive cut off": lambda path: path.write_bytes(b"PK\x03\x04" + bytes(100)),
    "an unpacked directory of a pipe": unpacked,
}
NAME = "xfeat_sparse_bnfolded.safetensors"
SAFETENSORS = {
    "a head of 2^63 bytes": (2**63).to_bytes(8, "little") + b"{}",
    "deep JSON": (200_000).to_bytes(8, "little") + b"[" * 200_000,
    "a tensor beyond the end": (80).to_bytes(8, "little")
    + b'{"a":{"dtype":"F32","shape":[99],"data_offsets":[0,396]}}'.ljust(80),
    "a shape of 2^62": (80).to_bytes(8, "little")
    + b'{"a":{"dtype":"F32","shape":[4611686018427387904,4],"data_offsets":[0,0]}}'.ljust(80),
}


def saved(value: Any, **options: Any) -> bytes:
    import torch

    stream = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # prototypes, says torch
        torch.save(value, stream, **options)
    return stream.getvalue()


def with_pickle(data: bytes) -> bytes:
    """An archive as torch writes it, its pickle replaced."""
    import torch

    whole = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(saved({"a": torch.zeros(2)}))) as old, zipfile.ZipFile(whole, "w") as new:
        for name in old.namelist():
            new.writestr(name, data if name.endswith("/data.pkl") else old.read(name))
    return whole.getvalue()


def legacy_with_pickle(data: bytes) -> bytes:
    """The same in the format before archives: the fourth of its pickles is the table."""
    import torch

    whole = saved({"a": torch.zeros(2)}, _use_new_zipfile_serialization=False)
    stream, ends = io.BytesIO(whole), []
    for _ in range(4):
        list(pickletools.genops(stream))
        ends.append(stream.tell())
    return whole[: ends[2]] + data + whole[ends[3] :]


def at(name: str, make: Callable[[], bytes]) -> Callable[[Path], object]:
    return lambda room: (room / name).write_bytes(make())


def listed(name: str, make: Callable[[Path], object]) -> Callable[[Path], object]:
    """The searched directory with one bad file."""

    def place(room: Path) -> None:
        (room / "weights" / "deep").mkdir(parents=True)
        make(room / "weights" / "deep" / name)

    return place


SEARCHED = {
    "cut off": lambda path: path.write_bytes(b"cut off"),
    "a pipe": os.mkfifo,
    "a link to nothing": lambda path: path.symlink_to("nothing"),
    "a bomb": lambda path: path.write_bytes(with_pickle(PICKLES["a bytearray of 6 GB"])),
}
SEARCH = "--weights weights"
AUTO = SUBMIT.replace("quick.toml", "auto") + f" {SEARCH} --mode stage-1"
CONVERT_SAFETENSORS = CONVERT.replace("a.pt", "a.safetensors")
CASES = [
    *(
        Case("weights", f"{name}{form}", CONVERT, at("a.pt", lambda m=make, d=data: m(d)), REFUSED)
        for form, make in (("", with_pickle), (", old format", legacy_with_pickle))
        for name, data in PICKLES.items()
    ),
    *(
        Case("weights", name, CONVERT, lambda room, m=make: m(room / "a.pt"), REFUSED)
        for name, make in FILES.items()
    ),
    *(
        Case(
            "weights", f"safetensors: {name}", CONVERT_SAFETENSORS, at("a.safetensors", lambda d=data: d), REFUSED
        )
        for name, data in SAFETENSORS.items()
    ),
    *(
        Case("weights", f"{NAME}, {name}: {said}", command, listed(NAME, make), statuses, NAME)
        for said, command, statuses in (
            ("verify", f"weights verify {SEARCH}", (1,)),
            ("recipe auto", AUTO, (0,)),
        )
        for name, make in SEARCHED.items()
    ),
    Case("weights", "a manifest is a pipe", f"weights list {SEARCH}", listed("weights_manifest.txt", os.mkfifo)),
]
