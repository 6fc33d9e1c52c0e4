"""Weight files that would run code, take all memory, or hold no tensors."""

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

from attack import Case
from room import SUBMIT, UNIT, written

NAME = "xfeat_sparse_bnfolded.safetensors"
SEARCH = "--weights weights"
AUTO = SUBMIT.replace("quick.toml", "auto:stage-1") + f" {SEARCH}"
# No digest is known of this file, so a run loads it.
QUADTREE = "weights/quadtree_outdoor.ckpt"
SAFE = "weights/quadtree.safetensors"
MANIFEST = written(
    "weights/weights_manifest.txt",
    '["quadtree.safetensors"]\nslot = "quadtree-outdoor"\nlicence = "MIT"\n',
)
RECIPE = written(
    "quick.toml", f"units = [{UNIT.format(1)}, {UNIT.format(1).replace('sift', 'quadtree')}]"
)
RUN = f"{SUBMIT} {SEARCH}"
LENGTH = (6 * 10**9).to_bytes(8, "little")
# A pickle is a program: some bytes of it ask for gigabytes, or for a depth that ends the process.
PICKLES = {
    "lists of lists": b"\x80\x02" + b"]" * 500_000 + b"a" * 499_999 + b".",
    "a bytearray of 6 GB": b"\x80\x02cbuiltins\nbytearray\n\x8a\x08" + LENGTH + b"\x85R.",
    "a tensor of 6 GB": b"\x80\x02ctorch\nFloatTensor\n\x8a\x08" + LENGTH + b"\x85R.",
    "a call of the system": b"\x80\x02cposix\nsystem\nX\x10\x00\x00\x00touch out/called\x85R.",
}
# The head of a file has its own length, and shapes and offsets that nothing has checked.
SAFETENSORS = {
    "a head of 2^63 bytes": (2**63).to_bytes(8, "little") + b"{}",
    "a tensor beyond the end": (80).to_bytes(8, "little")
    + b'{"a":{"dtype":"F32","shape":[99],"data_offsets":[0,396]}}'.ljust(80),
    "a shape of 2^62": (80).to_bytes(8, "little")
    + b'{"a":{"dtype":"F32","shape":[4611686018427387904,4],"data_offsets":[0,0]}}'.ljust(80),
}


def archive(data: bytes) -> bytes:
    """Return the smallest archive that torch takes for a checkpoint, with this pickle."""
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w") as file:
        file.writestr("archive/data.pkl", data)
        file.writestr("archive/version", "3\n")
    return whole.getvalue()


def loaded(name: str, file: str, data: bytes) -> Case:
    """The matcher of the file is left out, and the run goes on."""

    def make(room: Path) -> None:
        for part in (RECIPE, MANIFEST, written(file, data)):
            part(room)

    return Case("weights", name, RUN, make, says=f"{file} cannot be read as a checkpoint")


def cases() -> Iterator[Case]:
    for name, data in PICKLES.items():
        yield loaded(name, QUADTREE, archive(data))
        yield loaded(f"{name}, old format", QUADTREE, data)
    for name, data in SAFETENSORS.items():
        yield loaded(f"safetensors: {name}", SAFE, data)
    bomb = written(f"weights/deep/{NAME}", archive(PICKLES["a bytearray of 6 GB"]))
    yield Case("weights", f"{NAME} is a bomb", AUTO, bomb, says=NAME)
    for name, make in {
        "a bomb": bomb,
        "cut off": written(f"weights/deep/{NAME}", b"cut off"),
    }.items():
        yield Case(
            "weights",
            f"{NAME} is {name}, verified",
            f"weights verify {SEARCH}",
            make,
            (1,),
            NAME,
        )


CASES = [*cases()]
