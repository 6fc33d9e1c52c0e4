"""Reads a checkpoint whose pickle holds more than tensors, without running any of its code.

Training frameworks pickle callbacks and hyper-parameters beside the tensors, of classes that are not installed
here; ``torch.load(weights_only=True)`` refuses such files. It reads them once every name that it does not know
is mapped to :class:`Inert`, which does nothing; names of the operating system are still refused.
"""

import zipfile
from pathlib import Path


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

    require_stored(path)
    with safe_globals([(Inert, name) for name in get_unsafe_globals_in_checkpoint(path)]):
        return torch.load(path, map_location="cpu", weights_only=True)


def require_stored(path: Path) -> None:
    """Raise ``ValueError`` for a compressed archive: torch writes none, and a small one may unpack to anything."""
    with zipfile.ZipFile(path) as archive:
        for record in archive.infolist():
            if record.compress_type != zipfile.ZIP_STORED or record.compress_size != record.file_size:
                raise ValueError(f"record {Path(record.filename).name} is compressed, which torch never does")
