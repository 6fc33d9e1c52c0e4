"""What weight files are for: the matchers and recipes that use them, and the files that a name stands for."""

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.registry import registry, slots_of
from mkpc_kaggle.recipe import Recipe, load_recipe, recipe_names
from mkpc_kaggle.weights import WeightFile, WeightStore


def matchers_with(slot: str) -> list[str]:
    """The matchers that take the slot's weights, with some training or other."""
    return [name for name, entry in registry().items() if slot in entry.spec.every_slot]


def recipes_with(slot: str) -> list[str]:
    """The recipes whose matchers take the slot's weights."""
    return [name for name in recipe_names() if slot in slots_of_recipe(load_recipe(name))]


def slots_of_recipe(recipe: Recipe) -> tuple[str, ...]:
    return slots_of(recipe, recipe.matcher_names)


def files_of(name: str, store: WeightStore) -> list[list[WeightFile]]:
    """What a file's, a slot's or a recipe's name stands for: a list of files that will do for each slot.

    Raises :class:`UserError` with the known names for an unknown one.
    """
    if any(file.name == name for file in store.files):
        return [[file for file in store.files if file.name == name]]
    slots = list(dict.fromkeys(file.slot for file in store.files))
    if name in slots:
        return [store.alternatives(name)]
    if name in recipe_names() or name.endswith(".toml"):
        return [store.alternatives(slot) for slot in slots_of_recipe(load_recipe(name))]
    raise UserError(
        f"{name!r} is no file of the manifest (python -m mkpc_kaggle weights list names them), no slot "
        f"({', '.join(slots)}) and no recipe ({', '.join(recipe_names())})"
    )
