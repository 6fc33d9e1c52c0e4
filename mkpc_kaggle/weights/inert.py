"""Reads a checkpoint whose pickle holds more than tensors, without running any of its code.

Training frameworks pickle callbacks and hyper-parameters beside the tensors, of classes that are not installed
here; ``torch.load(weights_only=True)`` refuses such files. It reads them once every name that it does not know
is mapped to :class:`Inert`, which does nothing; names of the operating system are still refused. Before that the
pickle's opcodes are looked through: what would take all memory or the interpreter's stack is refused.
"""

import pickletools
import zipfile
from pathlib import Path
from typing import IO

LARGEST_PICKLE = 1 << 20
"""Bytes. 1,000 tensors take some 200 kB; a byte may become 200 in memory."""
LARGEST_TUPLE = 10_000
"""Items, those of the tuples in it included."""
LEGACY_PICKLES = 5
"""In a file from before torch 1.6: magic number, protocol, system, contents, storages; then the data."""


class Inert:
    """Stands for every class and function that torch does not know; all calls do nothing."""

    __slots__ = ()

    def __new__(cls, *_: object, **__: object) -> "Inert":
        return object.__new__(cls)

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def __call__(self, *_: object, **__: object) -> "Inert":
        return self

    def __setstate__(self, _: object) -> None:
        pass


def load_inert(path: Path) -> object:
    """The contents of a zip checkpoint, tensors on the CPU; all but tensors, containers and numbers is inert.

    Raises ``ValueError``, ``pickle.UnpicklingError`` and other errors for a malformed file.
    """
    import torch
    from torch.serialization import get_unsafe_globals_in_checkpoint, safe_globals

    require_plain(path)
    with safe_globals([(Inert, name) for name in get_unsafe_globals_in_checkpoint(path)]):
        return torch.load(path, map_location="cpu", weights_only=True)


def load_legacy(path: Path) -> object:
    """The contents of a checkpoint of the format before zip archives; it may hold no unknown classes."""
    import torch

    with path.open("rb") as stream:
        for _ in range(LEGACY_PICKLES):
            require_small(stream)
    return torch.load(path, map_location="cpu", weights_only=True)


def require_plain(path: Path) -> None:
    """Raise ``ValueError`` for an archive that torch does not write: a small one may unpack to anything."""
    with zipfile.ZipFile(path) as archive:
        records = archive.infolist()
        for record in records:
            if record.compress_type != zipfile.ZIP_STORED or record.compress_size != record.file_size:
                raise ValueError(f"record {Path(record.filename).name} is compressed, which torch never does")
        if sum(record.file_size for record in records) > path.stat().st_size:
            raise ValueError("its records overlap")
        for record in records:
            if record.filename.endswith("data.pkl"):
                with archive.open(record) as stream:
                    require_small(stream)


def require_small(stream: IO[bytes]) -> None:
    """Read one pickle's opcodes; raise ``ValueError`` for objects that are too large to be made.

    Python hashes a tuple by going down into all tuples within, wherever one occurs: deep ones end the process, and
    forty pairs of pairs take for ever. So the stack machine is followed, with the number of items for each object.
    """
    stack: list[int] = []
    memo: dict[object, int] = {}
    for opcode, argument, position in pickletools.genops(stream):
        taken = []
        for kind in reversed(opcode.stack_before):
            if kind is pickletools.stackslice:
                while stack[-1] != _MARK:
                    taken.append(stack.pop())
            else:
                taken.append(stack.pop())
        items = 1 + sum(taken) if opcode.name.startswith("TUPLE") else 1
        if items > LARGEST_TUPLE or (position or 0) > LARGEST_PICKLE:
            raise ValueError(f"its pickle is too large, or has a tuple of more than {LARGEST_TUPLE} items")
        if opcode.name == "GLOBAL" and str(argument).endswith(" bytearray"):
            raise ValueError("its pickle makes a bytearray, which may have any size")
        if opcode.name.endswith("PUT"):
            memo[argument] = stack[-1]
        for kind in opcode.stack_after:
            known = memo[argument] if opcode.name.endswith("GET") else items
            stack.append(_MARK if kind is pickletools.markobject else known)


_MARK = 0
