"""What keeps a recipe's matchers from running here: their code, their weights, the licence of these."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Matcher, Placement
from mkpc_kaggle.matchers.registry import load_matcher, spec_of
from mkpc_kaggle.pipeline.uses import options_of, slots_of, unusable
from mkpc_kaggle.recipe import Recipe
from mkpc_kaggle.weights import WeightStore

PERMISSIVE_TAGS = frozenset({"Apache-2.0", "BSD-3-Clause", "MIT"})


class Licence(StrEnum):
    """Which weights may be used, by their licence."""

    ANY = "any"
    PERMISSIVE = "permissive"
    """those that may be used for any purpose: Apache-2.0, BSD-3-Clause, MIT"""


class Hindrance(StrEnum):
    """Why a matcher cannot run."""

    BROKEN = "cannot be imported"
    REFUSED = "licence not permitted"
    MISSING = "no weights"
    UNREADABLE = "weights cannot be loaded"


@dataclass(frozen=True)
class Obstacle:
    """One matcher's hindrance; ``details`` are the error, the licences, or the slots that lack a file."""

    matcher: str
    hindrance: Hindrance
    details: tuple[str, ...]


@dataclass(frozen=True)
class Check:
    """Looks for obstacles; ``own`` are the user's ready matchers, which bring their weights along."""

    store: WeightStore
    licence: Licence = Licence.ANY
    own: Mapping[str, Matcher[Any]] = field(default_factory=dict)

    def obstacles(self, recipe: Recipe, names: Iterable[str], *, load: bool = False) -> list[Obstacle]:
        """Those of the matchers of these names, at most one each; ``load``: try weights of unknown digests.

        Raises :class:`UserError` for options that a matcher does not know.
        """
        found = (self._obstacle(recipe, name, load=load) for name in names)
        return [one for one in found if one is not None]

    def _obstacle(self, recipe: Recipe, name: str, *, load: bool) -> Obstacle | None:
        own = name in self.own
        if not own and (broken := unusable([name])):
            return Obstacle(name, Hindrance.BROKEN, (str(broken[0]),))
        if self.licence is Licence.PERMISSIVE and (others := self._licences(recipe, name) - PERMISSIVE_TAGS):
            return Obstacle(name, Hindrance.REFUSED, tuple(sorted(others)))
        slots = () if own else slots_of(recipe, [name])
        if missing := tuple(slot for slot in slots if self.store.find(slot) is None):
            return Obstacle(name, Hindrance.MISSING, missing)
        return self._loading(recipe, name, slots) if load else None

    def _loading(self, recipe: Recipe, name: str, slots: Iterable[str]) -> Obstacle | None:
        found = map(self.store.find, slots)
        try:
            if any(file is not None and not file.verified for file in found):
                load_matcher(name, self.store, options_of(recipe, name), Placement())
        except UserError as error:
            return Obstacle(name, Hindrance.UNREADABLE, (str(error),))
        return None

    def _licences(self, recipe: Recipe, name: str) -> set[str]:
        """What a matcher says of its weights, and what the manifest says of the files that were found for it."""
        if name in self.own:
            return set(self.own[name].spec.licences)
        found = map(self.store.find, slots_of(recipe, [name]))
        return {
            *spec_of(name, f"recipe {recipe.name!r}").licences,
            *(weights.file.licence for weights in found if weights),
        }


def require_none(recipe: Recipe, obstacles: Iterable[Obstacle], store: WeightStore) -> None:
    """Raise :class:`UserError` for obstacles, with what to do about them."""
    by_hindrance: dict[Hindrance, list[Obstacle]] = {}
    for one in obstacles:
        by_hindrance.setdefault(one.hindrance, []).append(one)
    for one in by_hindrance.get(Hindrance.BROKEN, []):
        spec_of(one.matcher, f"recipe {recipe.name!r}")  # says which recipe wants it
    if refused := by_hindrance.get(Hindrance.REFUSED):
        weights_of = ", ".join(f"{one.matcher} ({', '.join(one.details)})" for one in refused)
        raise UserError(
            f"--licence permissive refuses recipe {recipe.name!r} for the weights of {weights_of}. Take a recipe "
            "without them, such as permissive, or --recipe auto, which leaves them out."
        )
    if missing := by_hindrance.get(Hindrance.MISSING):
        slots = dict.fromkeys(slot for one in missing for slot in one.details)
        raise UserError(
            f"recipe {recipe.name!r} needs weights that were not found ({what_is_missing(slots, store)}). "
            "Name their directory with --weights, or use --recipe auto, which does with what there is."
        )


def what_is_missing(slots: Iterable[str], store: WeightStore) -> str:
    """The file names that would fill the slots."""
    return "; ".join(f"{slot}: {' or '.join(file.name for file in store.alternatives(slot))}" for slot in slots)
