"""Tensors from a checkpoint file, without running any code in it, and from there into a network."""

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights.inert import load_inert, load_legacy
from mkpc_kaggle.weights.unpacked import pack

if TYPE_CHECKING:
    import torch
    from torch import nn


MOST_EXPANSION = 4
"""How many times a file's bytes its tensors may have: some share theirs."""


def load_tensors(path: Path) -> "dict[str, torch.Tensor]":
    """Tensors by name, on the CPU, from a safetensors file or a torch checkpoint; nothing in the file is executed.

    ``path`` may be the directory into which a torch checkpoint was unpacked (``NAME/NAME`` on Kaggle).
    A training checkpoint has them under ``state_dict``, DISK's under ``extractor``; its other entries are left
    out. Raises :class:`UserError` for a file that cannot be read, or whose table of tensors holds anything
    else: tensors that are sparse, quantised, nested or on no device are none here, nor are those with more
    elements than the file has.
    """
    import torch

    try:
        table = _load_table(path)
    except Exception as error:
        raise UserError(f"{path} cannot be read as a checkpoint: {error}") from error
    odd = [
        str(name)
        for name, value in table.items()
        if not isinstance(name, str) or not isinstance(value, torch.Tensor) or not _is_plain(value)
    ]
    if odd:
        raise UserError(
            f"{path} cannot be read as a checkpoint: not all of its entries are plain tensors with a name: "
            f"{', '.join(odd[:5])}. Save the network's state_dict alone."
        )
    size = (
        path.stat().st_size
        if path.is_file()
        else sum(record.stat().st_size for record in path.rglob("*") if record.is_file())
    )
    if sum(tensor.nbytes for tensor in table.values()) > MOST_EXPANSION * size:
        raise UserError(f"{path} cannot be read as a checkpoint: its tensors are larger than the file")
    return {name: tensor.detach() for name, tensor in table.items()}


def load_into(
    network: "nn.Module", tensors: "Mapping[str, torch.Tensor]", *, what: str, unused: str = "$^"
) -> None:
    """Load a checkpoint into a network: all names and shapes must agree.

    Only entries whose names match the pattern ``unused`` may be missing or surplus. A network made on the device
    "meta" takes over the tensors themselves, so that a large one is not in memory twice. Raises
    :class:`UserError` naming some of those that do not fit.
    """
    own = network.state_dict()
    odd = [name for name in own.keys() ^ tensors.keys() if not re.match(unused, name)]
    odd += [name for name in own.keys() & tensors.keys() if own[name].shape != tensors[name].shape]
    if odd:
        raise UserError(f"the weights for {what!r} do not fit the network: {', '.join(sorted(odd)[:5])}")
    fitting = {name: tensor.to(own[name].dtype) for name, tensor in tensors.items() if name in own}
    network.load_state_dict({**own, **fitting}, assign=any(tensor.is_meta for tensor in own.values()))


def _is_plain(tensor: "torch.Tensor") -> bool:
    """Whether its elements lie in memory, one by one."""
    import torch

    return (
        tensor.layout is torch.strided
        and tensor.device.type == "cpu"
        and not (tensor.is_quantized or tensor.is_nested)
        and tensor.nbytes <= tensor.untyped_storage().nbytes()
    )


def _load_table(path: Path) -> Mapping[Any, Any]:
    if path.is_dir():
        with TemporaryDirectory(prefix="mkpc-") as temporary:
            return _load_table(pack(path, Path(temporary) / "checkpoint.pt"))
    if path.exists() and not path.is_file():
        raise ValueError("no regular file")
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        return load_file(path)
    try:
        if zipfile.is_zipfile(path):
            return _state_dict(load_inert(path))
        return _state_dict(load_legacy(path))
    except (RuntimeError, EOFError, UnpicklingError, LookupError) as refusal:
        # torch's message advises to load it unsafely.
        raise ValueError(
            "it is none, or holds objects that are not read here; save the network's state_dict alone"
        ) from refusal


def _state_dict(contents: object) -> Mapping[Any, Any]:
    """The table of tensors in what a file holds."""
    table = contents
    if isinstance(contents, dict):
        table = contents.get("state_dict", contents.get("extractor", contents))
    if not isinstance(table, dict):
        raise ValueError("it holds no table of tensors by name")
    return table
