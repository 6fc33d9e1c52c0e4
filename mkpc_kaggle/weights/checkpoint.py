"""Checkpoint files: loading tensors without running code, filling networks."""

import re
import textwrap
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mkpc_kaggle.errors import UserError

if TYPE_CHECKING:
    import torch
    from torch import nn

# Entries that hold the tensors, of training checkpoints and of DISK.
WRAPPERS = ("model", "state_dict", "extractor")
PARALLEL = "module."  # begins all names in checkpoints of torch.nn.DataParallel
MAX_MESSAGE = 300  # characters of torch's list of missing and unexpected entries


def load_tensors(path: Path) -> "dict[str, torch.Tensor]":
    """Load tensors by name from a safetensors file or a torch checkpoint without executing code.

    The names are those of the network: wrappers such as ``{"model": {"state_dict": ...}}`` and the
    prefix of parallel training are removed. Raises :class:`UserError` if the file cannot be read or
    an entry is not a tensor with a name.
    """
    import torch
    from safetensors.torch import load_file

    table: Any
    try:
        if path.suffix == ".safetensors":
            table = load_file(path)
        else:
            # Older files are no archives, which alone can be mapped into memory.
            is_mapped = zipfile.is_zipfile(path)
            table = torch.load(path, map_location="cpu", weights_only=True, mmap=is_mapped)
    # Any error: a damaged file makes torch, zipfile and safetensors raise errors of many types.
    # torch's message recommends an unsafe way to load the file.
    except Exception as error:
        kind = type(error).__name__
        raise UserError(
            f"{path} cannot be read as a checkpoint ({kind}): it is damaged, or has other objects "
            "than tensors; save the network's state_dict alone"
        ) from error
    for name in (*WRAPPERS, *WRAPPERS):
        if isinstance(table, dict) and isinstance(table.get(name), dict):
            table = table[name]
    if not isinstance(table, dict):
        raise UserError(f"{path} cannot be read as a checkpoint: it is no table of tensors")
    for name, tensor in table.items():
        if not isinstance(name, str) or not isinstance(tensor, torch.Tensor):
            raise UserError(
                f"{path} cannot be read as a checkpoint: {name!r} is no named tensor"
            )
    is_parallel = all(name.startswith(PARALLEL) for name in table)
    tensors = {}
    for name, tensor in table.items():
        own = name.removeprefix(PARALLEL) if is_parallel else name
        tensors[own] = tensor.detach()  # without gradients, which parameters have
    return tensors


def load_into(
    network: "nn.Module",
    tensors: "Mapping[str, torch.Tensor]",
    *,
    what: str,
    unused: str = "$^",
) -> None:
    """Load a checkpoint into a network: all names and shapes must agree.

    Only counters of batch norms, and entries whose names match the pattern ``unused``, may be
    missing or surplus. A network on the device "meta" takes the tensors themselves, so that a large
    network is not in memory twice. Raises :class:`UserError` with the first differences.
    """
    own = network.state_dict()
    table = {name: tensor for name, tensor in own.items() if re.match(unused, name)}
    for name, tensor in tensors.items():
        if name in own:
            # Files in half precision are converted once, here.
            table[name] = tensor.to(own[name].dtype)
        elif not re.match(unused, name):
            table[name] = tensor
    is_meta = any(tensor.is_meta for tensor in own.values())
    try:
        network.load_state_dict(table, strict=True, assign=is_meta)
    except RuntimeError as error:
        reason = textwrap.shorten(str(error), MAX_MESSAGE, placeholder=" ...")
        raise UserError(
            f"the weights for {what!r} do not fit the network: {reason}"
        ) from error
