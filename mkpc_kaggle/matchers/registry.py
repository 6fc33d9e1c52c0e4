"""Finds the matchers: every module of this package that has a ``SPEC`` and a ``load``."""

import pkgutil
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from typing import Any

from mkpc_kaggle import matchers
from mkpc_kaggle.config import from_table
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Matcher, MatcherEntry, MatcherSpec, Placement, Registry
from mkpc_kaggle.recipe import Recipe
from mkpc_kaggle.weights import WeightStore


@cache
def registry() -> Registry:
    """All matchers by name. A new one is a new file in this package; nothing else changes."""
    modules = [
        import_module(f"{matchers.__name__}.{info.name}") for info in pkgutil.iter_modules(matchers.__path__)
    ]
    entries = [MatcherEntry(module.SPEC, module.load) for module in modules if hasattr(module, "SPEC")]
    return {entry.spec.name: entry for entry in entries}


def spec_of(name: str, where: str) -> MatcherSpec:
    """The spec of a registered matcher; :class:`UserError` with the known ones for an unknown name."""
    if name not in registry():
        raise UserError(f"{where}: unknown matcher {name!r}; known: {', '.join(sorted(registry()))}")
    return registry()[name].spec


def options_of(recipe: Recipe, name: str) -> Any:
    """The matcher's options with what the recipe's ``[matchers.NAME]`` changes."""
    spec = spec_of(name, f"recipe {recipe.name!r}")
    table = recipe.matchers.get(name, {})
    return from_table(spec.options, table, f"recipe {recipe.name!r}, table [matchers.{name}]")


def slots_of(recipe: Recipe, names: Iterable[str]) -> tuple[str, ...]:
    """What these registered matchers need of the manifest with the recipe's options, each slot once."""
    slots = (slot for name in names for slot in registry()[name].spec.slots_for(options_of(recipe, name)))
    return tuple(dict.fromkeys(slots))


def load_matcher(recipe: Recipe, name: str, weights: WeightStore, placement: Placement) -> Matcher[Any]:
    """The matcher, ready to run; raises :class:`UserError` where its weights are missing or damaged."""
    return registry()[name].load(weights, options_of(recipe, name), placement)
