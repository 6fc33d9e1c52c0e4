"""Which weight files go into the dataset, and in what form."""

from dataclasses import dataclass, replace
from pathlib import Path

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.package.checkout import Checkout
from mkpc_kaggle.package.folder import Item
from mkpc_kaggle.weights import FoundFile, State, WeightFile, WeightStore
from mkpc_kaggle.weights.convert import convert

HEADER = "# The weights of this dataset; the columns are name, bytes, digest, licence, slot, source.\n"


@dataclass(frozen=True)
class ChosenWeights:
    """The files to include, with the texts of their licences, and those that must not be redistributed.

    ``manifest`` has a line for each of the ``items``. ``restricted`` are left out, or, in a private package, are
    among the ``items``.
    """

    items: tuple[Item, ...]
    manifest: str
    licence_texts: tuple[Item, ...]
    restricted: tuple[Item, ...]


def choose_weights(store: WeightStore, checkout: Checkout, staging: Path, *, private: bool) -> ChosenWeights:
    """The file of each slot that the store has, as safetensors: Kaggle would unpack a torch checkpoint.

    Conversions go into ``staging``. Licences whose text the checkout has allow redistribution.
    Raises :class:`mkpc_kaggle.errors.UserError` for a slot of which only damaged files were found, and for a
    checkpoint that cannot be read.
    """
    slots = dict.fromkeys(file.slot for file in store.files)
    found = [one for one in (_good_file(store, slot) for slot in slots) if one is not None]
    restricted = [one for one in found if checkout.licence_text(one.file.licence) is None]
    shipped = [one for one in found if private or one not in restricted]
    texts = {checkout.licence_text(one.file.licence) for one in shipped} - {None, checkout.licence}
    files = [_as_safetensors(one, staging) for one in shipped]
    return ChosenWeights(
        tuple(
            Item(file.name, path, file.licence, _note(one))
            for (file, path), one in zip(files, shipped, strict=True)
        ),
        HEADER + "".join(f"{file.line}\n" for file, _ in files),
        tuple(Item(path.name, path) for path in sorted(filter(None, texts))),
        tuple(Item(one.file.name, one.path, one.file.licence) for one in restricted),
    )


def _good_file(store: WeightStore, slot: str) -> FoundFile | None:
    search = store.search(store.alternatives(slot))
    if search.found is None and search.refused:
        refusals = "; ".join(f"{one.path}: {one.note}" for one in search.refused)
        raise UserError(
            f"no good file for {slot!r}. Found {refusals}. Fetch it again "
            f"(python -m mkpc_kaggle weights fetch {slot} --out DIR), or take it out of the directory."
        )
    return search.found


def _as_safetensors(found: FoundFile, staging: Path) -> tuple[WeightFile, Path]:
    """The manifest's line of the safetensors file, and its path."""
    if found.path.suffix == ".safetensors":
        return replace(found.file, size=found.path.stat().st_size, digest=found.digest), found.path
    # The whole name, suffix included: the manifest may know another conversion under the shorter one.
    path = staging / f"{found.file.name}.safetensors"
    made = convert(found.path, path)
    source = f"{found.file.name} ({found.digest}) with the same tensor names"
    return replace(made, licence=found.file.licence, slot=found.file.slot, source=source), path


def _note(found: FoundFile) -> str:
    return "" if found.state is State.GOOD else "its original is not verified"
