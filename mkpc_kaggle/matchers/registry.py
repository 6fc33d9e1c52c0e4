"""Finds matchers by name: a file of this folder is a matcher, with a ``SPEC`` of its name and a ``load``."""

import pkgutil
from functools import cache
from importlib import import_module
from typing import Any

from mkpc_kaggle import matchers
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Matcher, MatcherEntry, MatcherSpec, Placement, Unusable
from mkpc_kaggle.weights import WeightStore

# What matchers share.
NOT_MATCHERS = frozenset(
    {"contract", "dense", "dtypes", "lightglue", "neighbours", "registry", "semi_dense", "sparse", "vismatch"}
)


@cache
def matcher_names() -> tuple[str, ...]:
    """The names of all matchers; imports none of them. A new matcher is a new file."""
    modules = pkgutil.iter_modules(matchers.__path__)
    return tuple(info.name for info in modules if not info.ispkg and info.name not in NOT_MATCHERS)


@cache
def find_matcher(name: str) -> MatcherEntry | Unusable:
    """The matcher of this name, imported now; why it cannot be used, where its import fails.

    Raises ``KeyError`` for a name that is not among :func:`matcher_names`.
    """
    if name not in matcher_names():
        raise KeyError(name)
    try:
        module = import_module(f"{matchers.__name__}.{name}")
        return MatcherEntry(module.SPEC, module.load)
    except Exception as error:  # any error at import affects this matcher only
        return Unusable(name, f"{type(error).__name__}: {error}")


def spec_of(name: str, where: str) -> MatcherSpec:
    """The spec of a matcher; :class:`UserError`, with ``where`` it was asked for, if it is unknown or broken."""
    return _entry(name, where).spec


def load_matcher(name: str, weights: WeightStore, options: Any, placement: Placement) -> Matcher[Any]:
    """The matcher, ready to run; raises :class:`UserError` where its weights are missing or damaged."""
    return _entry(name, "load").load(weights, options, placement)


def _entry(name: str, where: str) -> MatcherEntry:
    if name not in matcher_names():
        raise UserError(f"{where}: unknown matcher {name!r}; known: {', '.join(matcher_names())}")
    entry = find_matcher(name)
    if isinstance(entry, Unusable):
        raise UserError(f"{where}: {entry}. `--recipe auto` does without it.")
    return entry
