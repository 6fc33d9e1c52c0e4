"""The weights manifest, and checkpoints found by it, verified and loaded without running any code.

``weights_manifest.txt`` has one line a file, columns split by blanks, ``#`` starts a comment::

    name  bytes  digest  licence  slot  source

``digest`` is ``sha256:<hex>`` or ``unverified``; ``bytes`` is a number or ``?``. A *slot* is what a matcher
asks for; lines of one slot are alternatives, the first that is found is taken.
"""

import hashlib
import os
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from mkpc_kaggle.errors import UserError

if TYPE_CHECKING:
    import torch
    from torch import nn

KAGGLE_INPUT = Path("/kaggle/input")
UNVERIFIED = "unverified"


@dataclass(frozen=True)
class WeightFile:
    """One line of the manifest; ``size`` in bytes, -1 where it is not known."""

    name: str
    size: int
    digest: str
    licence: str
    slot: str
    source: str


@dataclass(frozen=True)
class FoundWeights:
    """A file of the manifest on this machine, with the digest that its bytes have."""

    file: WeightFile
    path: Path
    digest: str


def parse_manifest(text: str, where: str = "the weights manifest") -> tuple[WeightFile, ...]:
    """All lines of a manifest; raises :class:`UserError` naming the line that cannot be read."""
    files = []
    for number, line in enumerate(text.splitlines(), start=1):
        columns = line.partition("#")[0].split(maxsplit=5)
        if not columns:
            continue
        if len(columns) != 6:
            raise UserError(f"{where}, line {number}: expected 6 columns, found {len(columns)}")
        name, size, digest, licence, slot, source = columns
        if Path(name).name != name:
            raise UserError(f"{where}, line {number}: {name!r} is not a plain file name")
        if size != "?" and not size.isdigit():
            raise UserError(f"{where}, line {number}: bytes must be a number or '?', not {size!r}")
        if digest != UNVERIFIED and not digest.startswith("sha256:"):
            raise UserError(
                f"{where}, line {number}: digest must be 'sha256:...' or '{UNVERIFIED}', not {digest!r}"
            )
        files.append(WeightFile(name, -1 if size == "?" else int(size), digest, licence, slot, source.strip()))
    return tuple(files)


@cache
def manifest() -> tuple[WeightFile, ...]:
    """The manifest that came with the package (in a wheel: inside it; in a checkout: beside it)."""
    here = Path(__file__).resolve().parent
    for path in (here / "weights_manifest.txt", here.parent / "weights_manifest.txt"):
        if path.is_file():
            return parse_manifest(path.read_text(encoding="utf-8"), str(path))
    raise UserError(f"weights_manifest.txt is missing from {here}: install the package again")


class WeightStore:
    """Weight files in search directories: ``--weights``, then ``$MKPC_WEIGHTS``, then ``/kaggle/input/**``."""

    def __init__(self, directories: Iterable[Path] = (), files: Sequence[WeightFile] | None = None) -> None:
        given = list(directories)
        for directory in given:
            if not directory.is_dir():
                raise UserError(f"--weights {directory}: no such directory")
        environment = [Path(part) for part in os.environ.get("MKPC_WEIGHTS", "").split(os.pathsep) if part]
        self.directories = given + environment + ([KAGGLE_INPUT] if KAGGLE_INPUT.is_dir() else [])
        self.files = manifest() if files is None else tuple(files)
        self._located: dict[str, FoundWeights | None] = {}

    def alternatives(self, slot: str) -> list[WeightFile]:
        """The manifest's lines for a slot, in order of preference; raises ``KeyError`` for an unknown slot."""
        lines = [file for file in self.files if file.slot == slot]
        if not lines:
            raise KeyError(f"no file in the manifest is for the slot {slot!r}")
        return lines

    def find(self, slot: str) -> FoundWeights | None:
        """The slot's file, its bytes checked against the manifest; ``None`` where there is none.

        Raises :class:`UserError` for a file that is not what the manifest says.
        """
        if slot not in self._located:
            self._located[slot] = self._locate(slot)
        return self._located[slot]

    def load(self, slot: str) -> "dict[str, torch.Tensor]":
        """The slot's tensors by name, on the CPU; raises :class:`UserError` where the file is missing."""
        found = self.find(slot)
        if found is None:
            names = " or ".join(file.name for file in self.alternatives(slot))
            searched = ", ".join(map(str, self.directories)) or "nowhere: name a directory with --weights"
            raise UserError(f"no weights for {slot!r}: {names} not found (searched {searched})")
        return load_tensors(found.path)

    def _locate(self, slot: str) -> FoundWeights | None:
        for file in self.alternatives(slot):
            for directory in self.directories:
                # The directory itself first: a walk through /kaggle/input costs seconds.
                direct = directory / file.name
                deeper = (path for path in sorted(directory.rglob(file.name)) if path.is_file())
                path = direct if direct.is_file() else next(deeper, None)
                if path is not None:
                    return FoundWeights(file, path, verify(path, file))
        return None


def verify(path: Path, file: WeightFile) -> str:
    """The file's digest, ``sha256:<hex>``, after it was held against the manifest.

    Raises :class:`UserError` where size or digest differ; an unverified file warns and names its digest, so
    that it can be pinned.
    """
    size = path.stat().st_size
    if file.size >= 0 and size != file.size:
        raise UserError(
            f"{path}: {size} bytes, the manifest says {file.size}: truncated, or another file. Fetch it again."
        )
    with path.open("rb") as stream:
        digest = "sha256:" + hashlib.file_digest(stream, "sha256").hexdigest()
    if file.digest == UNVERIFIED:
        warnings.warn(
            f"{path} is not verified: the manifest has no digest for it; this file's is {digest}", stacklevel=2
        )
    elif digest != file.digest:
        raise UserError(f"{path}: its digest is {digest}, the manifest says {file.digest}. Fetch it again.")
    return digest


def load_tensors(path: Path) -> "dict[str, torch.Tensor]":
    """Tensors by name from a safetensors file or a torch checkpoint; nothing in the file is executed.

    A training checkpoint keeps them under ``state_dict``.
    """
    import torch
    from safetensors.torch import load_file

    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        loaded = torch.load(path, map_location="cpu", weights_only=True)
        return dict(loaded.get("state_dict", loaded))
    except Exception as error:
        raise UserError(f"{path} cannot be read as a checkpoint: {error}") from error


def load_into(
    network: "nn.Module", tensors: "Mapping[str, torch.Tensor]", *, what: str, unused: str = "$^"
) -> None:
    """Load a checkpoint into a network: every name and every shape must agree.

    Only entries whose names match the pattern ``unused`` may be missing or surplus. Raises
    :class:`UserError` naming some of those that do not fit.
    """
    own = network.state_dict()
    odd = [name for name in own.keys() ^ tensors.keys() if not re.match(unused, name)]
    odd += [name for name in own.keys() & tensors.keys() if own[name].shape != tensors[name].shape]
    if odd:
        raise UserError(f"the weights for {what!r} do not fit the network: {', '.join(sorted(odd)[:5])}")
    network.load_state_dict({**own, **{name: tensor for name, tensor in tensors.items() if name in own}})
