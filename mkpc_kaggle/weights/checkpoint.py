"""Checkpoint files: loading tensors without running code, filling networks, conversion."""

import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any

from mkpc_kaggle.data.outputs import require_apart
from mkpc_kaggle.errors import UserError, temporary_directory
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile, digest_of, manifest

if TYPE_CHECKING:
    import torch
    from torch import nn

# Entries that hold the tensors, of training checkpoints and of DISK.
WRAPPERS = ("state_dict", "model", "extractor")
PARALLEL = "module."  # begins all names in checkpoints of torch.nn.DataParallel
MAX_NAMED = 5  # entries of each kind in a message
LFS_START = b"version https://git-lfs.github.com/spec/"
PAGE_STARTS = (b"<!doctype html", b"<html", b"<?xml")
# Of a batch norm, used in training only; old files have none.
COUNTER = re.compile(r"(.*\.)?num_batches_tracked")
MAX_WRAPPINGS = 4  # such as {"model": {"state_dict": ...}}
MAX_EXPANSION = 4  # bytes of tensors per byte of the file; some tensors share their bytes


class Inert:
    """An inert stand-in for classes and functions in a pickle that torch does not know."""

    def __new__(cls, *_: object, **__: object) -> "Inert":
        return object.__new__(cls)

    def __setstate__(self, _: object) -> None:
        pass


def load_tensors(path: Path, device: str = "cpu") -> "dict[str, torch.Tensor]":
    """Load tensors by name from a safetensors file or a torch checkpoint without executing code.

    ``path`` may be the directory of an unpacked torch checkpoint (``NAME/NAME`` on Kaggle). Some
    checkpoints have their tensors under one of :data:`WRAPPERS`. Other entries are ignored. On the
    device "meta", tensors have names, shapes and types only: the file is mapped into memory, and
    its numbers are not read. Raises :class:`UserError` if the file cannot be read or an entry is
    not a dense tensor with a name. The same error is raised if the tensors have many more bytes
    than the file.
    """
    import torch

    try:
        # Inside another device's context, torch puts tensors of old checkpoints there.
        with torch.device("cpu"):
            table = _load_table(path, is_mapped=device == "meta")
        _require_plain(table, path)
    # Any error: a damaged file makes torch, zipfile and safetensors raise errors of many types.
    except Exception as error:
        reason = no_checkpoint(path) or error
        raise UserError(f"{path} cannot be read as a checkpoint: {reason}") from error
    is_parallel = bool(table) and all(name.startswith(PARALLEL) for name in table)
    tensors = {}
    for name, tensor in table.items():
        own = name.removeprefix(PARALLEL) if is_parallel else name
        tensors[own] = tensor.detach().to(device)  # without gradients, which parameters have
    return tensors


def no_checkpoint(path: Path) -> str:
    """Return what a file is that is no checkpoint but came in the place of one; empty if unknown."""
    try:
        if not path.is_file():  # a pipe would block
            return ""
        with path.open("rb") as stream:
            start = stream.read(1 << 10).lstrip()
    except OSError:
        return ""
    if start.startswith(LFS_START):
        return (
            "it is a pointer of Git LFS, and not the file itself: `git lfs pull` gets it, "
            "or download the file from its page"
        )
    if start.lower().startswith(PAGE_STARTS):
        return "it is a web page, such as a login or an error, and not the file itself: download it again"
    return ""


def load_into(
    network: "nn.Module", tensors: "Mapping[str, torch.Tensor]", *, what: str, unused: str = "$^"
) -> None:
    """Load a checkpoint into a network: all names and shapes must agree.

    Only counters of batch norms, and entries whose names match the pattern ``unused``, may be
    missing or surplus. A network on the device "meta" takes the tensors themselves, so that a large
    network is not in memory twice. Raises :class:`UserError` that names missing entries, surplus
    ones and other shapes, up to five of each.
    """
    own = network.state_dict()

    def counts(name: str) -> bool:
        return not re.match(unused, name) and not COUNTER.fullmatch(name)

    missing = [name for name in own if name not in tensors and counts(name)]
    surplus = [name for name in tensors if name not in own and counts(name)]
    reshaped = [
        f"{name} {tuple(tensors[name].shape)} instead of {tuple(own[name].shape)}"
        for name in own
        if name in tensors and own[name].shape != tensors[name].shape
    ]
    sides = {
        "the network also has": missing,
        "the file also has": surplus,
        "other shapes": reshaped,
    }
    if any(sides.values()):
        texts = [f"{side} {_named(names)}" for side, names in sides.items() if names]
        raise UserError(f"the weights for {what!r} do not fit the network: {'; '.join(texts)}")
    # Files in half precision are converted once, here.
    fitting = {}
    for name in own.keys() & tensors.keys():
        fitting[name] = tensors[name].to(own[name].dtype)
    is_meta = any(tensor.is_meta for tensor in own.values())
    network.load_state_dict({**own, **fitting}, assign=is_meta)


def _named(names: Sequence[str]) -> str:
    """Return the first names, sorted, and the number of the others."""
    shown = ", ".join(sorted(names)[:MAX_NAMED])
    more = len(names) - MAX_NAMED
    return f"{shown} and {more} more" if more > 0 else shown


def convert_file(source: Path, target: Path, line: WeightFile | None = None) -> WeightFile:
    """Write copies of the tensors of ``source`` to ``target``; return the target's manifest line.

    ``line`` is the manifest line of the source, by default found by digest, then by name. Raises
    :class:`UserError` if the source cannot be read, the target cannot be written, or its name does
    not end in ``.safetensors``.
    """
    if target.suffix != ".safetensors":
        raise UserError(f"--out {target}: the name must end in .safetensors")
    require_apart({"--out": target}, [source])
    tensors = load_tensors(source)
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    part = target.with_name(f"{target.name}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        part.unlink(missing_ok=True)  # it may be a link
        # safetensors refuses views and tensors that share their bytes.
        copies = {name: tensor.contiguous().clone() for name, tensor in tensors.items()}
        save_file(copies, part)
        part.replace(target)
    except KeyError as error:
        raise UserError(f"{source}: safetensors has no type for tensors of {error}") from error
    except (OSError, SafetensorError) as error:
        raise UserError(f"{target} cannot be written: {error}") from error
    line = line or _line_of(source) or WeightFile(source.name, -1, UNVERIFIED, "?", "?", "")
    origin = f"{line.name} ({digest_of(source)}) with the same tensor names"
    return WeightFile(
        target.name, target.stat().st_size, digest_of(target), line.licence, line.slot, origin
    )


def _line_of(source: Path) -> WeightFile | None:
    """Return the manifest line of a file: by digest, by name, or as an unpacked checkpoint."""
    digest = digest_of(source)
    lines = manifest()
    for file in lines:
        if file.digest == digest:
            return file
    for file in lines:
        if file.name == source.name and file.digest == UNVERIFIED:
            return file
    for file in lines:
        if source.is_dir() and is_unpacked_from(source, file):
            return file
    return None


def is_unpacked_from(directory: Path, file: WeightFile) -> bool:
    """Return whether ``directory`` has a name that Kaggle gives to the unpacked ``file``.

    Kaggle unpacks uploaded archives, and torch checkpoints are archives: ``NAME.pth`` becomes
    ``NAME/NAME/{data.pkl, data/, version, ...}``, with or without the suffix in the outer name.
    """
    folder_names = {directory.name, directory.parent.name}
    return bool(folder_names & {file.name, Path(file.name).stem})


def _require_plain(table: Mapping[Any, Any], path: Path) -> None:
    """Raise ``ValueError`` unless all entries are named dense tensors.

    The same error is raised if they are much larger than the file.
    """
    for name, value in table.items():
        if not isinstance(name, str) or not _is_dense(value):
            raise ValueError(
                f"entry {name!r} is not a plain named tensor; save the network's state_dict alone"
            )
    files = [file for file in (path, *path.rglob("*")) if file.is_file()]
    file_bytes = sum(file.stat().st_size for file in files)
    # A few bytes may expand to a huge tensor, whose elements share one number.
    if sum(tensor.nbytes for tensor in table.values()) > MAX_EXPANSION * file_bytes:
        raise ValueError("its tensors are larger than the file")


def _is_dense(value: Any) -> bool:
    """Return whether a value is a plain tensor with numbers on the CPU."""
    import torch

    if not isinstance(value, torch.Tensor) or value.is_quantized or value.is_nested:
        return False
    return value.layout == torch.strided and value.device.type == "cpu"


def _load_table(path: Path, *, is_mapped: bool = False) -> Mapping[Any, Any]:
    """Return the table of tensors. With ``is_mapped``, their numbers are read on first use."""
    if path.is_dir():
        # torch reads archives only. Without mapping, as the archive is removed again.
        with temporary_directory() as temporary:
            return _load_table(_pack(path, temporary / "checkpoint.pt"))
    if path.exists() and not path.is_file():
        raise ValueError("not a regular file")
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        return load_file(path)  # always mapped
    try:
        contents = _unpickle(path, is_mapped=is_mapped)
    except (RuntimeError, EOFError, UnpicklingError, LookupError) as refusal:
        # torch's message recommends an unsafe way to load the file.
        raise ValueError(
            "it is not a checkpoint, or contains unsupported objects; save the network's state_dict alone"
        ) from refusal
    contents = _unwrapped(contents)
    if not isinstance(contents, dict):
        raise ValueError("it contains no table of named tensors")
    return contents


def _unwrapped(contents: object) -> object:
    """Return the table of tensors of a training checkpoint, at any depth; anything else as it is."""
    for _ in range(MAX_WRAPPINGS):
        tables = [
            contents[name]
            for name in WRAPPERS
            if isinstance(contents, dict) and isinstance(contents.get(name), dict)
        ]
        if not tables:
            break
        contents = tables[0]
    return contents


def _pack(directory: Path, file: Path) -> Path:
    """Pack an unpacked checkpoint into the archive ``file``; raises ``OSError``."""
    # Mounted files may have dates in 1970, before the format's first year.
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, strict_timestamps=False) as archive:
        for path in sorted(path for path in directory.rglob("*") if path.is_file()):
            archive.write(path, f"archive/{path.relative_to(directory).as_posix()}")
    return file


def _unpickle(path: Path, *, is_mapped: bool) -> object:
    """Return the contents of a torch checkpoint, with tensors on the CPU.

    Training frameworks pickle callbacks and settings whose classes are not installed here.
    ``weights_only=True`` refuses them, so in archives their names are mapped to :class:`Inert`.
    Names of the operating system are still refused. A checkpoint in the older format must not
    contain unknown names.
    """
    import torch
    from torch.serialization import get_unsafe_globals_in_checkpoint, safe_globals

    if not zipfile.is_zipfile(path):
        return torch.load(path, map_location="cpu", weights_only=True)
    with zipfile.ZipFile(path) as archive:
        # A zip bomb: a small file that would fill the memory.
        if sum(record.file_size for record in archive.infolist()) > path.stat().st_size:
            raise ValueError("its records are compressed or overlap, which torch never writes")
    with safe_globals([(Inert, name) for name in get_unsafe_globals_in_checkpoint(path)]):
        return torch.load(path, map_location="cpu", weights_only=True, mmap=is_mapped)
