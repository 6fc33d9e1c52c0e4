"""The files of both folders: choice of weights and licences, conversion to safetensors, writing."""

import filecmp
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.availability import fit_of
from mkpc_kaggle.weights import FoundFile, State, WeightFile, WeightStore
from mkpc_kaggle.weights.checkpoint import convert

HEADER = (
    "# The weights of this dataset; the columns are name, bytes, digest, licence, slot, source.\n"
)


@dataclass(frozen=True)
class Item:
    """A file to write: name in the folder, source, and licence if it has its own."""

    name: str
    source: Path
    licence: str = ""
    note: str = ""


def refuse_other_files(directory: Path, items: Sequence[Item]) -> None:
    """Raise :class:`UserError` if the folder has files that are not in ``items``: they would be
    uploaded too.
    """
    names = {name for item in items for name in (item.name, f".{item.name}.part")}
    others = sorted({path.name for path in directory.glob("*")} - names)
    if others:
        raise UserError(
            f"{directory} contains files that would be uploaded too: {', '.join(others)}. Remove them, or choose "
            "another --out."
        )


def write_files(directory: Path, items: Sequence[Item]) -> tuple[Item, ...]:
    """Write the items into the folder, except identical existing files. Return the items with their
    new paths.

    Raises :class:`UserError` if a file cannot be written. A repeated call resumes.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for item in items:
            target, part = directory / item.name, directory / f".{item.name}.part"
            part.unlink(missing_ok=True)
            if target.is_file() and filecmp.cmp(item.source, target, shallow=False):
                continue
            with item.source.open("rb") as source, part.open("xb") as copy:  # "x" follows no link
                shutil.copyfileobj(source, copy)
            part.replace(target)
    except OSError as error:
        raise UserError(f"{directory} cannot be written: {error}") from error
    return tuple(replace(item, source=directory / item.name) for item in items)


@dataclass(frozen=True)
class ChosenWeights:
    """The files to include, the texts of their licences, and the files that must not be
    redistributed.
    """

    items: tuple[Item, ...]
    manifest: str  # a line per item
    licence_texts: tuple[Item, ...]
    restricted: tuple[Item, ...]  # excluded unless the package is private


def choose_weights(
    store: WeightStore, checkout: Path, staging: Path, *, private: bool
) -> ChosenWeights:
    """Choose the file of each slot in the store, as safetensors, since Kaggle would unpack a torch
    checkpoint.

    Conversions are written to ``staging``. A licence allows redistribution if the checkout has its
    text. Raises :class:`UserError` if a slot has only damaged files, or a checkpoint cannot be read
    or fits no network.
    """
    slots = dict.fromkeys(file.slot for file in store.files)
    every = [found for found in (_good_file(store, slot) for slot in slots) if found is not None]
    restricted = [found for found in every if licence_text(checkout, found.file.licence) is None]
    shipped = [found for found in every if private or found not in restricted]
    texts = {text for found in shipped if (text := licence_text(checkout, found.file.licence))}
    notes = [_note(found, store) for found in shipped]
    files = [_as_safetensors(found, staging) for found in shipped]
    return ChosenWeights(
        tuple(
            Item(file.name, path, file.licence, note)
            for (file, path), note in zip(files, notes, strict=True)
        ),
        HEADER + "".join(f"{file.line}\n" for file, _ in files),
        tuple(Item(path.name, path) for path in sorted(texts) if path.name != "LICENSE"),
        tuple(Item(found.file.name, found.path, found.file.licence) for found in restricted),
    )


def licence_text(checkout: Path, tag: str) -> Path | None:
    """Return the path of a licence's text if the checkout has it. ``tag`` is its name in the
    manifest.
    """
    texts = {path.stem: path for path in (checkout / "licences").glob("*.txt")}
    return (texts | {"Apache-2.0": checkout / "LICENSE"}).get(tag)


def _note(found: FoundFile, store: WeightStore) -> str:
    """Return a note on digest and networks. Raise :class:`UserError` if no network takes the file."""
    fit = fit_of(found, store)
    if fit.is_refused:
        raise UserError(
            f"{found.path}: {fit.text}. Remove it from the directory, or fetch the right file."
        )
    verified = "" if found.state is State.GOOD else "its original is not verified"
    return "; ".join(filter(None, [verified, fit.text]))


def _good_file(store: WeightStore, slot: str) -> FoundFile | None:
    search = store.search(store.alternatives(slot))
    if search.found is None and search.refused:
        refusals = "; ".join(f"{refused.path}: {refused.note}" for refused in search.refused)
        raise UserError(
            f"no good file for {slot!r}. Found {refusals}. Fetch it again "
            f"(mkpc weights fetch {slot} --out DIR), or remove it from the directory."
        )
    return search.found


def _as_safetensors(found: FoundFile, staging: Path) -> tuple[WeightFile, Path]:
    """Return the manifest line and path of a file as safetensors, converted if necessary."""
    if found.path.suffix == ".safetensors":
        return replace(found.file, size=found.path.stat().st_size, digest=found.digest), found.path
    # The full name, with its suffix: the manifest may list another conversion under the shorter
    # name.
    path = staging / f"{found.file.name}.safetensors"
    return convert(found.path, path, found.file), path
