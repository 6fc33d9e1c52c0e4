"""What recipes use: matchers with their options, slots of weights; and which matchers and recipes use a slot."""

from collections.abc import Iterable
from typing import Any

from mkpc_kaggle.config import from_table
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import MatcherEntry, Unusable
from mkpc_kaggle.matchers.registry import find_matcher, matcher_names, spec_of
from mkpc_kaggle.recipe import Recipe, load_recipe, recipe_names
from mkpc_kaggle.weights import WeightFile, WeightStore


def options_of(recipe: Recipe, name: str) -> Any:
    """The matcher's options with what the recipe's ``[matchers.NAME]`` changes."""
    spec = spec_of(name, f"recipe {recipe.name!r}")
    table = recipe.matchers.get(name, {})
    return from_table(spec.options, table, f"recipe {recipe.name!r}, table [matchers.{name}]")


def slots_of(recipe: Recipe, names: Iterable[str]) -> tuple[str, ...]:
    """What these matchers need of the manifest with the recipe's options, each slot once."""
    where = f"recipe {recipe.name!r}"
    slots = (slot for name in names for slot in spec_of(name, where).slots_for(options_of(recipe, name)))
    return tuple(dict.fromkeys(slots))


def unusable(names: Iterable[str] | None = None) -> tuple[Unusable, ...]:
    """Those of these matchers, or of all, that cannot be imported here; names of no matcher are passed over."""
    asked = matcher_names() if names is None else dict.fromkeys(names)
    found = (find_matcher(name) for name in asked if name in matcher_names())
    return tuple(one for one in found if isinstance(one, Unusable))


def matchers_with(slot: str) -> list[str]:
    """The matchers that take the slot's weights, with some training or other."""
    entries = {name: find_matcher(name) for name in matcher_names()}
    return [
        name
        for name, entry in entries.items()
        if isinstance(entry, MatcherEntry) and slot in entry.spec.every_slot
    ]


def recipes_with(slot: str) -> list[str]:
    """The recipes whose matchers take the slot's weights."""
    return [name for name in recipe_names() if slot in slots_of_recipe(load_recipe(name))]


def slots_of_recipe(recipe: Recipe) -> tuple[str, ...]:
    """The slots of all the recipe's matchers that can be used here."""
    broken = {one.name for one in unusable(recipe.matcher_names)}
    return slots_of(recipe, [name for name in recipe.matcher_names if name not in broken])


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
