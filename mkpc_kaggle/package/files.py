"""The files of both folders: choice of weights and licences, conversion to safetensors, writing."""

import filecmp
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.setup.availability import fit_of
from mkpc_kaggle.weights import FileState, FoundFile, WeightFile, WeightStore
from mkpc_kaggle.weights.checkpoint import convert_file

HEADER = (
    "# The weights of this dataset; the columns are name, bytes, digest, licence, slot, source.\n"
)


@dataclass(frozen=True)
class PackageFile:
    """A file to write: name in the folder, source, and licence if it has its own."""

    name: str
    source: Path
    licence: str = ""
    note: str = ""


def refuse_other_files(directory: Path, items: Sequence[PackageFile]) -> None:
    """Raise :class:`UserError` if the folder has files that are not in ``items``.

    They would be uploaded too.
    """
    names = {name for item in items for name in (item.name, f".{item.name}.part")}
    others = sorted({path.name for path in directory.glob("*")} - names)
    if others:
        raise UserError(
            f"{directory} contains files that would be uploaded too: {', '.join(others)}. Remove them, or choose "
            "another --out."
        )


def write_items(directory: Path, items: Sequence[PackageFile]) -> tuple[PackageFile, ...]:
    """Write the items into the folder; return them with their new paths.

    Identical files are kept, so a repeated call resumes. Raises :class:`UserError` if a file cannot
    be written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for item in items:
            target = directory / item.name
            # Renamed when it is complete: a cut file would have the right name.
            part = directory / f".{item.name}.part"
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
    """The files to include, their licences' texts, and the files that must not be redistributed."""

    items: tuple[PackageFile, ...]
    manifest: str  # a line per item
    licence_texts: tuple[PackageFile, ...]
    restricted: tuple[PackageFile, ...]  # excluded unless the package is private


def choose_weights(
    store: WeightStore, checkout: Path, staging: Path, *, private: bool
) -> ChosenWeights:
    """Choose the file of each slot in the store, as safetensors.

    Kaggle would unpack a torch checkpoint. Conversions are written to ``staging``. A licence allows
    redistribution if the checkout has its text. Raises :class:`UserError` if a slot has only
    damaged files, or a checkpoint cannot be read or fits no network.
    """
    shipped: list[FoundFile] = []
    restricted: list[PackageFile] = []
    texts: set[Path] = set()
    for slot in dict.fromkeys(file.slot for file in store.files):
        found = _good_file(store, slot)
        if found is None:
            continue
        text = licence_text(checkout, found.file.licence)
        if text is None:
            restricted.append(PackageFile(found.file.name, found.path, found.file.licence))
        elif text.name != "LICENSE":  # the package's own, which the dataset always has
            texts.add(text)
        if text is not None or private:
            shipped.append(found)

    # All are tried in their networks before the first is converted.
    notes = [_note(found, store) for found in shipped]
    items: list[PackageFile] = []
    lines: list[str] = []
    for found, note in zip(shipped, notes, strict=True):
        file, path = _as_safetensors(found, staging)
        items.append(PackageFile(file.name, path, file.licence, note))
        lines.append(f"{file.line}\n")
    licence_texts = tuple(PackageFile(path.name, path) for path in sorted(texts))
    return ChosenWeights(tuple(items), HEADER + "".join(lines), licence_texts, tuple(restricted))


def licence_text(checkout: Path, tag: str) -> Path | None:
    """Return the path of a licence's text if the checkout has it; ``tag`` as in the manifest."""
    texts = {path.stem: path for path in (checkout / "licences").glob("*.txt")}
    texts["Apache-2.0"] = checkout / "LICENSE"  # the package's own licence
    return texts.get(tag)


def _note(found: FoundFile, store: WeightStore) -> str:
    """Return a note on digest and networks. Raise :class:`UserError` if no network takes it."""
    # Now, and not after an upload of gigabytes.
    fit = fit_of(found, store)
    if fit.is_refused:
        raise UserError(
            f"{found.path}: {fit.text}. Remove it from the directory, or fetch the right file."
        )
    verified = "" if found.state is FileState.GOOD else "its original is not verified"
    return "; ".join(filter(None, [verified, fit.text]))


def _good_file(store: WeightStore, slot: str) -> FoundFile | None:
    """Return a slot's file, or ``None`` without a file.

    Raises :class:`UserError` if all of them are damaged: the dataset would be incomplete without a word.
    """
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
        # The manifest's line may have no size and digest.
        size = found.path.stat().st_size
        return replace(found.file, size=size, digest=found.digest), found.path
    # The full name, with its suffix: the manifest may list another conversion under the shorter
    # name.
    path = staging / f"{found.file.name}.safetensors"
    return convert_file(found.path, path, found.file), path
