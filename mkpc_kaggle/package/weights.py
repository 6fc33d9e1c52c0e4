"""Which weight files go into the dataset."""

from dataclasses import dataclass

from mkpc_kaggle.package.checkout import Checkout
from mkpc_kaggle.package.folder import Item
from mkpc_kaggle.weights import State, WeightStore


@dataclass(frozen=True)
class Chosen:
    """The files that go in, with the texts of their licences, and those that must not be passed on.

    ``restricted`` are left out, or, in a private package, are among the ``items``.
    """

    items: tuple[Item, ...]
    licence_texts: tuple[Item, ...]
    restricted: tuple[Item, ...]


def choose_weights(store: WeightStore, checkout: Checkout, *, private: bool) -> Chosen:
    """The file of each slot that the store has, under the manifest's name.

    A licence allows to pass a file on if it is one whose text the checkout has. Raises
    :class:`mkpc_kaggle.errors.UserError` for a slot of which only damaged files were found.
    """
    slots = dict.fromkeys(file.slot for file in store.files)
    found = [one for one in map(store.find, slots) if one is not None]
    items = tuple(
        Item(one.file.name, one.path, one.file.licence, "not verified" if one.state is State.UNVERIFIED else "")
        for one in found
    )
    restricted = tuple(item for item in items if checkout.licence_text(item.licence) is None)
    shipped = tuple(item for item in items if private or item not in restricted)
    texts = {checkout.licence_text(item.licence) for item in shipped} - {None, checkout.licence}
    return Chosen(shipped, tuple(Item(path.name, path) for path in sorted(filter(None, texts))), restricted)
