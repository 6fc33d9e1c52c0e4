"""Availability of a recipe's matchers: code, weights, and the licences of the weights."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any

from mkpc_kaggle.config import from_table
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Matcher
from mkpc_kaggle.matchers.registry import MATCHERS, misfit, spec_of
from mkpc_kaggle.recipe import Recipe, load_recipe, recipe_names
from mkpc_kaggle.weights import FoundFile, MissingWeights, WeightStore, load_tensors

PERMISSIVE_TAGS = frozenset({"Apache-2.0", "BSD-3-Clause", "MIT"})


class Licence(StrEnum):
    """The user's choice of weights by their licence."""

    ANY = "any"
    PERMISSIVE = "permissive"  # usable for any purpose: Apache-2.0, BSD-3-Clause, MIT


class UnavailableKind(StrEnum):
    """Causes, with the texts of messages."""

    NOT_PERMITTED = "weights not permitted"
    NO_WEIGHTS = "no weights"
    UNREADABLE = "weights cannot be loaded"


# The other kinds are the user's choices.
FAULTS = (UnavailableKind.UNREADABLE,)


@dataclass(frozen=True)
class UnavailableReason:
    """Reason why a matcher is unavailable.

    ``detail`` is the error, the licences, or the missing files.
    """

    kind: UnavailableKind
    detail: str
    missing: MissingWeights = field(default_factory=MissingWeights)

    def __str__(self) -> str:
        return f"{self.kind} ({self.detail})"


def unavailable(
    recipe: Recipe,
    store: WeightStore,
    licence: Licence = Licence.ANY,
    own: Mapping[str, Matcher[Any]] = MappingProxyType({}),
) -> dict[str, UnavailableReason]:
    """Return the reasons, by name, why matchers of the recipe (fallbacks included) cannot run here.

    ``own`` has the user's matchers. Each of the others is loaded on the device "meta": a file with
    the manifest's digest may still not fit the network. Raises :class:`UserError` for an unknown
    matcher or option.
    """
    names = [name for unit in recipe.units for name in (unit.matcher, unit.fallback) if name]
    reasons = {}
    for name in dict.fromkeys(names):
        if name in own:
            # A ready matcher has its weights; only licences count.
            reason = _without_licence(set(own[name].spec.licences), licence)
        else:
            reason = _reason(name, recipe, store, licence)
        if reason is not None:
            reasons[name] = reason
    return reasons


def _reason(
    name: str, recipe: Recipe, store: WeightStore, licence: Licence
) -> UnavailableReason | None:
    """Return why a matcher cannot run here, or ``None``."""
    spec = spec_of(name, f"recipe {recipe.name!r}")
    options = options_of(recipe, name)
    found = {slot: store.file_of(slot) for slot in spec.slots_for(options)}
    missing = store.missing(found)
    # Of missing files, too: nobody should fetch what the run would refuse.
    licences = set(spec.licences)
    for slot, file in found.items():
        lines = store.alternatives(slot) if file is None else [file.file]
        licences |= {line.licence for line in lines}
    refused = _without_licence(licences, licence)
    if refused is not None:
        return refused
    if missing:
        return UnavailableReason(UnavailableKind.NO_WEIGHTS, str(missing), missing)
    if found and (problem := misfit(name, store, options)):
        return UnavailableReason(UnavailableKind.UNREADABLE, problem)
    return None


def _without_licence(licences: set[str], licence: Licence) -> UnavailableReason | None:
    """Return the reason if the user's choice of licences excludes one of these."""
    others = licences - PERMISSIVE_TAGS
    if not others or licence is not Licence.PERMISSIVE:
        return None
    return UnavailableReason(UnavailableKind.NOT_PERMITTED, ", ".join(sorted(others)))


@dataclass(frozen=True)
class Fit:
    """The result of loading a weight file into the networks that use it: a text for a table."""

    is_refused: bool
    text: str


def fit_of(found: FoundFile, store: WeightStore) -> Fit:
    """Load a file into the network of each matcher that uses it, on the device "meta".

    Matchers of several files get the others from the store. If these are missing or at fault, the
    file is not tried.
    """
    slot = found.file.slot
    fitting: list[str] = []
    untried: list[str] = []
    try:
        # Also a file that no matcher uses must be readable.
        load_tensors(found.path, "meta")
        for name in MATCHERS:
            spec = spec_of(name, "weights")
            if (options := spec.options_for(slot)) is None:
                continue
            others = [other for other in spec.slots_for(options) if other != slot]
            # A network of two files cannot be tried with one.
            missing = [other for other in others if store.file_of(other) is None]
            problem = "" if missing else misfit(name, store.on_meta(found), options)
            # Another file of the matcher may be at fault; messages name the slot.
            if repr(slot) in problem:
                raise UserError(problem)
            if missing or problem:
                untried.append(problem or f"{name} also needs {', '.join(missing)}")
            else:
                fitting.append(name)
    except UserError as error:
        return Fit(True, str(error))
    if fitting:
        return Fit(False, f"fits {', '.join(fitting)}")
    return Fit(False, f"not tried in a network: {'; '.join(untried)}" if untried else "")


def refusal(recipe: Recipe, reasons: Mapping[str, UnavailableReason]) -> UserError:
    """Return an error that names the matchers unavailable for the first reason, and the remedy."""
    kind = next(iter(reasons.values())).kind
    # One kind at a time: each has another remedy.
    those = "; ".join(
        f"{name} ({reason.detail})" for name, reason in reasons.items() if reason.kind is kind
    )
    if kind is UnavailableKind.NOT_PERMITTED:
        what = f"--licence permissive refuses recipe {recipe.name!r} for the weights of {those}"
        return UserError(
            f"{what}. Take a recipe without them, such as permissive, or --recipe auto."
        )
    if kind is UnavailableKind.NO_WEIGHTS:
        what = f"recipe {recipe.name!r} needs weights that were not found: {those}"
        return UserError(
            f"{what}. Name their directory with --weights, get them with "
            f"`{fetch_command(recipe, reasons)}`, or use --recipe auto, which needs none."
        )
    what = f"recipe {recipe.name!r} has no unit left that can sweep all pairs: {kind}: {those}"
    return UserError(f"{what}. Use --recipe auto, which runs without these matchers.")


def missing_weights(reasons: Iterable[UnavailableReason]) -> MissingWeights:
    """Return the missing weights of several matchers."""
    missing = MissingWeights()
    for reason in reasons:
        missing |= reason.missing
    return missing


def fetch_command(recipe: Recipe, reasons: Mapping[str, UnavailableReason]) -> str:
    """Return the command that gets a recipe's missing weights."""
    # ``weights fetch`` knows the names of the package's recipes only.
    name = recipe.name if recipe.name in recipe_names() else ""
    return missing_weights(reasons.values()).command(name)


def left_out(
    recipe: Recipe, reasons: Mapping[str, UnavailableReason], *, is_auto: bool = False
) -> tuple[str, ...]:
    """Return a text for each kind of reason, such as "no weights: loma, superglue", for a summary.

    Missing weights come with the command that gets them. Recipe auto could use several GB under any
    licence; the advice is then the recipe light, unless its weights are available.
    """
    texts = []
    for kind in dict.fromkeys(reason.kind for reason in reasons.values()):
        names = [name for name, reason in reasons.items() if reason.kind is kind]
        text = f"{kind}: {', '.join(names)}"
        missing = missing_weights(reasons[name] for name in names)
        light = load_recipe("light")
        is_light_missing = not missing.files.keys().isdisjoint(slots_of(light, light.matcher_names))
        if missing and (is_light_missing or not is_auto):
            text += f" (`{missing.command('light' if is_auto else '')}` gets weights)"
        texts.append(text)
    return tuple(texts)


def options_of(recipe: Recipe, name: str) -> Any:
    """Return the matcher's options: defaults, overridden by the recipe's ``[matchers.NAME]``."""
    where = f"recipe {recipe.name!r}"
    table = recipe.matchers.get(name, {})
    return from_table(spec_of(name, where).options, table, f"{where}, table [matchers.{name}]")


def slots_of(recipe: Recipe, names: Iterable[str]) -> tuple[str, ...]:
    """Return the distinct slots of a recipe's named matchers."""
    slots: list[str] = []
    for name in names:
        slots += spec_of(name, f"recipe {recipe.name!r}").slots_for(options_of(recipe, name))
    return tuple(dict.fromkeys(slots))
