"""Reads a checkpoint whose pickle holds more than tensors, and runs nothing of it.

Training frameworks pickle hyper-parameters and callbacks beside the tensors, of classes that are not installed
here; ``torch.load(weights_only=True)`` refuses such files. This reader knows torch's zip format by itself: the
pickle may name what it likes, but a name is never imported. The few that make up tensors give plain values that
say where a tensor's bytes lie; all others give :class:`Inert`. The tensors that are wanted are read afterwards.

The format: ``NAME/data.pkl``, whose persistent ids are ``("storage", type, key, device, items)``, and
``NAME/data/KEY``, the bytes of each storage, not compressed.
"""

import pickle
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import torch

DTYPES = {
    "DoubleStorage": "float64",
    "FloatStorage": "float32",
    "HalfStorage": "float16",
    "BFloat16Storage": "bfloat16",
    "LongStorage": "int64",
    "IntStorage": "int32",
    "ShortStorage": "int16",
    "CharStorage": "int8",
    "ByteStorage": "uint8",
    "BoolStorage": "bool",
    "ComplexFloatStorage": "complex64",
    "ComplexDoubleStorage": "complex128",
}
"""What the names of torch's storage types say of their items."""


class Storage(NamedTuple):
    """Items that tensors share; ``dtype`` is torch's name of it."""

    dtype: str
    key: str
    items: int


class StoredTensor(NamedTuple):
    """A tensor yet to be read: a strided window on a storage, counted in items."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]


class Inert:
    """Stands for every class and function that the pickle names: whatever is done to it does nothing."""

    __slots__ = ()

    def __new__(cls, *_: object, **__: object) -> "Inert":
        return object.__new__(cls)

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def __call__(self, *_: object, **__: object) -> "Inert":
        return self

    # Without self: a pickle may also ask the class for them.
    def __setstate__(*_: object) -> None:
        pass

    append = extend = add = __setitem__ = __setstate__


class Table(dict[Any, Any]):
    """An ``OrderedDict`` of the pickle, without the attributes that it may carry."""

    __slots__ = ()

    def __setstate__(*_: object) -> None:
        pass


class _RebuildTensor:
    """Called by the pickle for every tensor. An object without attributes, so that no pickle can change it."""

    __slots__ = ()

    def __call__(
        self,
        storage: object,
        offset: int,
        shape: tuple[int, ...],
        stride: tuple[int, ...],
        requires_grad: bool = False,
        hooks: object = None,
        metadata: object = None,
    ) -> StoredTensor:
        if not isinstance(storage, Storage) or metadata:
            raise pickle.UnpicklingError("it holds a tensor of a kind that is not read here")
        return StoredTensor(storage, offset, shape, stride)


class _RebuildParameter:
    """Called by the pickle for a tensor that was a parameter."""

    __slots__ = ()

    def __call__(self, tensor: object, requires_grad: bool = False, hooks: object = None) -> StoredTensor:
        if not isinstance(tensor, StoredTensor):
            raise pickle.UnpicklingError("it holds a parameter that is no tensor")
        return tensor


KNOWN: Mapping[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): Table,
    ("torch._utils", "_rebuild_tensor_v2"): _RebuildTensor(),
    ("torch._utils", "_rebuild_parameter"): _RebuildParameter(),
    **{("torch", name): dtype for name, dtype in DTYPES.items()},
}
"""All that a pickle can have by name; every value is safe to call and closed to change."""


class InertUnpickler(pickle.Unpickler):
    """Unpickles containers, numbers, strings and :class:`StoredTensor`; imports nothing and calls only ours."""

    def find_class(self, module: str, name: str) -> Any:
        return KNOWN.get((module, name), Inert)

    def persistent_load(self, pid: Any) -> Storage:
        kind, dtype, key, _, items = pid
        known = dtype in DTYPES.values() and isinstance(key, str) and isinstance(items, int)
        if kind != "storage" or not known:
            raise pickle.UnpicklingError("it holds a storage of a kind that is not read here")
        return Storage(dtype, key, items)


def load_inert(path: Path, choose: Callable[[object], Mapping[Any, Any]]) -> dict[Any, Any]:
    """The table that ``choose`` picks from a zip checkpoint's contents, its tensors on the CPU.

    Tensors that share a storage go on sharing it. What is no tensor stays as it is, inert. Raises ``ValueError``,
    ``zipfile.BadZipFile`` or ``pickle.UnpicklingError`` and what else a malformed file provokes.
    """
    with zipfile.ZipFile(path) as archive:
        reader = _Reader(archive)
        table = choose(reader.contents())
        return {
            name: reader.tensor(value) if isinstance(value, StoredTensor) else value
            for name, value in table.items()
        }


class _Reader:
    """Reads the records of an open archive."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        names = archive.namelist()
        roots = [name.removesuffix("data.pkl") for name in names if name.count("/") == 1 and "/data.pkl" in name]
        if len(roots) != 1:
            raise ValueError("a zip file, but no checkpoint")
        self._root = roots[0]
        if f"{self._root}byteorder" in names and self._read("byteorder") != b"little":
            raise ValueError("written on a big-endian machine")
        self._flat: dict[Storage, torch.Tensor] = {}

    def contents(self) -> object:
        with self._open("data.pkl") as stream:
            return InertUnpickler(stream).load()

    def tensor(self, stored: StoredTensor) -> "torch.Tensor":
        if stored.storage not in self._flat:
            self._flat[stored.storage] = self._storage(stored.storage)
        return self._flat[stored.storage].as_strided(stored.shape, stored.stride, stored.offset)

    def _storage(self, storage: Storage) -> "torch.Tensor":
        import torch

        dtype: torch.dtype = getattr(torch, storage.dtype)
        record, size = f"data/{storage.key}", storage.items * dtype.itemsize
        if self._archive.getinfo(self._root + record).file_size != size:
            raise ValueError(f"record {record} has not the {size} bytes that it should have")
        flat = torch.empty(storage.items, dtype=dtype)
        with self._open(record) as stream:
            stream.readinto(flat.view(torch.uint8).numpy())  # type: ignore[attr-defined]
        return flat

    def _read(self, record: str) -> bytes:
        with self._open(record) as stream:
            return stream.read()

    def _open(self, record: str) -> IO[bytes]:
        info = self._archive.getinfo(self._root + record)
        if info.compress_type != zipfile.ZIP_STORED or info.compress_size != info.file_size:
            raise ValueError(f"record {record} is compressed, which torch never does")
        return self._archive.open(info)
