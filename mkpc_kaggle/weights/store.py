"""The weight files of this machine, found by name or by digest."""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights.checkpoint import load_tensors
from mkpc_kaggle.weights.found import FoundFile, examine, examine_unpacked, recognise
from mkpc_kaggle.weights.manifest import MANIFEST, UNVERIFIED, WeightFile, manifest, read_manifest
from mkpc_kaggle.weights.notices import warn_once
from mkpc_kaggle.weights.tree import Tree

if TYPE_CHECKING:
    import torch

KAGGLE_INPUT = Path("/kaggle/input")


@dataclass(frozen=True)
class Search:
    """What was found, if anything, and files of the right name that were refused."""

    found: FoundFile | None
    refused: tuple[FoundFile, ...] = ()


class WeightStore:
    """Weight files in search directories: ``--weights``, then ``$MKPC_WEIGHTS``, then ``/kaggle/input/**``.

    They are compared with ``files``; by default the package's manifest and those in the search directories, which
    list weights that ``package`` converted.
    """

    def __init__(self, directories: Iterable[Path] = (), files: Sequence[WeightFile] | None = None) -> None:
        given = list(directories)
        for directory in given:
            if not directory.is_dir():
                raise UserError(f"--weights {directory}: no such directory")
        environment = [Path(part) for part in os.environ.get("MKPC_WEIGHTS", "").split(os.pathsep) if part]
        self.directories = given + environment + ([KAGGLE_INPUT] if KAGGLE_INPUT.is_dir() else [])
        self._given_files = None if files is None else tuple(files)
        self._trees = [Tree(place) for place in dict.fromkeys(self.directories) if place.is_dir()]
        self._searches: dict[tuple[WeightFile, ...], Search] = {}

    @cached_property
    def files(self) -> tuple[WeightFile, ...]:
        """The lines to compare with, one for each name; the package's manifest comes first.

        Where it has no digest, one of a manifest in the search directories counts: what was first fetched there.
        """
        if self._given_files is not None:
            return self._given_files
        lines = {file.name: file for file in manifest()}
        for tree in self._trees:
            for path in tree.named(MANIFEST):
                try:
                    here = read_manifest(path)
                except UserError as error:
                    warn_once(f"passed over: {error}")
                    continue
                for file in here:
                    known = lines.setdefault(file.name, file)
                    if known.digest == UNVERIFIED:
                        lines[file.name] = replace(known, size=file.size, digest=file.digest)
        return tuple(lines.values())

    def alternatives(self, slot: str) -> list[WeightFile]:
        """The manifest's lines for a slot, in order of preference; raises ``KeyError`` for an unknown slot."""
        lines = [file for file in self.files if file.slot == slot]
        if not lines:
            raise KeyError(f"no file in the manifest is for the slot {slot!r}")
        return lines

    def find(self, slot: str) -> FoundFile | None:
        """The slot's file, its bytes checked against the manifest; ``None`` where there is none.

        A file that is not what the manifest says is skipped with a warning.
        """
        search = self.search(self.alternatives(slot))
        for one in search.refused:
            warn_once(f"passed over: {one.path}: {one.note}")
        return search.found

    def load(self, slot: str) -> "dict[str, torch.Tensor]":
        """The slot's tensors by name, on the CPU; raises :class:`UserError` where the file is missing."""
        found = self.find(slot)
        if found is None:
            names = " or ".join(file.name for file in self.alternatives(slot))
            raise UserError(f"no weights for {slot!r}: {names} not found (searched {self.searched})")
        return load_tensors(found.path)

    @property
    def searched(self) -> str:
        """The search directories, for messages."""
        return ", ".join(map(str, self.directories)) or "nowhere: name a directory with --weights"

    def search(self, lines: Sequence[WeightFile]) -> Search:
        """The first good file of these lines, searched by name and then by digest; cached."""
        key = tuple(lines)
        if key not in self._searches:
            self._searches[key] = self._search(lines)
        return self._searches[key]

    def verify(self) -> list[FoundFile]:
        """Every file found, by path: those with a name of the manifest, and others with one of its digests."""
        lines = {file.name: file for file in self.files}
        found = {
            path: examine(path, lines[path.name], self.files)
            for tree in self._trees
            for path in tree.files
            if path.name in lines
        }
        for one in (*self._unpacked(self.files), *self._by_digest(self.files)):
            found.setdefault(one.path, one)
        return sorted(found.values(), key=lambda one: one.path)

    def _search(self, lines: Sequence[WeightFile]) -> Search:
        refused: list[FoundFile] = []
        for one in self._by_name(lines):
            if one.state.usable:
                return Search(one, tuple(refused))
            refused.append(one)
        found = next(self._by_digest(lines), None) or next(self._unpacked(lines), None)
        return Search(found, tuple(one for one in refused if found is None or one.path != found.path))

    def _by_name(self, lines: Sequence[WeightFile]) -> Iterator[FoundFile]:
        for file in lines:
            for tree in self._trees:
                for path in tree.named(file.name):
                    yield examine(path, file, self.files)

    def _unpacked(self, lines: Sequence[WeightFile]) -> Iterator[FoundFile]:
        for file in lines:
            for tree in self._trees:
                for path in tree.unpacked_named(file.name):
                    yield examine_unpacked(path, file)

    def _by_digest(self, lines: Sequence[WeightFile]) -> Iterator[FoundFile]:
        for file in lines:
            if file.digest == UNVERIFIED:
                continue
            for tree in self._trees:
                for path in tree.candidates(file.size):
                    found = recognise(path, file)
                    if found is not None:
                        yield found
