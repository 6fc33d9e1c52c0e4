"""Finds the matchers: every file of this folder that defines a ``SPEC`` and a ``load``, named as the matcher."""

import pkgutil
import re
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from mkpc_kaggle import matchers
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Matcher, MatcherEntry, MatcherSpec, Placement, Unusable
from mkpc_kaggle.weights import WeightStore


@cache
def matcher_names() -> tuple[str, ...]:
    """The names of all matchers, read from the files without importing one. A new matcher is a new file."""
    modules = [info.name for info in pkgutil.iter_modules(matchers.__path__) if not info.ispkg]
    return tuple(name for name in modules if _defines_spec(name))


@cache
def find_matcher(name: str) -> MatcherEntry | Unusable:
    """The matcher of this name, imported now; why it cannot be used, where its import fails.

    Raises ``KeyError`` for a name that is not among :func:`matcher_names`.
    """
    if name not in matcher_names():
        raise KeyError(name)
    try:
        module = import_module(_module(name))
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
    found = find_matcher(name)
    if isinstance(found, Unusable):
        raise UserError(f"{where}: {found}. `--recipe auto` does without it.")
    return found


def _defines_spec(name: str) -> bool:
    spec = find_spec(_module(name))
    assert spec is not None
    assert spec.origin is not None
    source = Path(spec.origin).read_text(encoding="utf-8")
    return re.search(r"^SPEC\b", source, re.MULTILINE) is not None


def _module(name: str) -> str:
    return f"{matchers.__name__}.{name}"
