"""The registry of matchers: a file of ``adapters/`` is a matcher, with a ``SPEC`` and a ``load``.

Matchers of the library vismatch are named ``vismatch:NAME``.
"""

import pkgutil
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from typing import Any

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers import adapters
from mkpc_kaggle.matchers.contract import Matcher, MatcherSpec, Placement
from mkpc_kaggle.weights import WeightStore

# Begins the names of vismatch's matchers, which need no file in ``adapters/``.
VISMATCH = "vismatch:"


class UnusableError(UserError):
    """Error for a matcher that cannot be imported here; ``__cause__`` is the import's error."""


@cache
def matcher_names() -> tuple[str, ...]:
    """Return the names of all matchers, one per file, without importing them."""
    return tuple(info.name for info in pkgutil.iter_modules(adapters.__path__))


def spec_of(name: str, where: str) -> MatcherSpec:
    """Import a matcher and return its spec.

    Error messages start with ``where``, the source of the name. Raises :class:`UserError` for an
    unknown name, :class:`UnusableError` if the import fails.
    """
    spec: MatcherSpec = _imported(name, where).SPEC
    return spec


def load_matcher(
    name: str, weights: WeightStore, options: Any, placement: Placement
) -> Matcher[Any]:
    """Return the matcher, ready to run.

    Raises :class:`UserError` if its weights are missing or damaged.
    """
    matcher: Matcher[Any] = _imported(name, "load").load(weights, options, placement)
    return matcher


def misfit(name: str, weights: WeightStore, options: Any) -> str:
    """Return why the weights cannot be loaded into the matcher's networks, or an empty text.

    This compares names and shapes on the device "meta", which takes no memory. Only a
    :class:`UserError` speaks against weights.
    """
    import torch

    try:
        with torch.device("meta"):
            load_matcher(name, weights.on_meta(), options, Placement("meta"))
    except UserError as error:
        return str(error)
    except Exception:
        # Says nothing of the weights: an adapter that computes while it loads fails on tensors
        # without numbers. The run loads it on a device with numbers. If it fails there, too, the
        # run reports that, and continues with the other matchers.
        return ""
    return ""


def _imported(name: str, where: str) -> Any:
    """Return the module of a matcher, or for vismatch an object with the same interface."""
    is_vismatch = name.startswith(VISMATCH)
    if not is_vismatch and name not in matcher_names():
        known = ", ".join(matcher_names())
        raise UserError(f"{where}: unknown matcher {name!r}; known: {known}, {VISMATCH}NAME")
    try:
        if is_vismatch:
            module = import_module("mkpc_kaggle.matchers.vismatch")
            return module.adapter_of(name.removeprefix(VISMATCH))
        return import_module(f"{adapters.__name__}.{name}")
    # Any error, not only ImportError: a broken installation of a library raises all kinds, and
    # only this matcher is affected.
    except Exception as error:
        message = f"matcher {name} cannot be used here ({type(error).__name__}: {error})"
        raise UnusableError(f"{where}: {message}. `--recipe auto` runs without it.") from error


def require_matchers(matchers: Mapping[str, Matcher[Any]]) -> Mapping[str, Matcher[Any]]:
    """Return the user's matchers. Raise ``TypeError`` unless they are a mapping from names."""
    if not isinstance(matchers, Mapping):
        raise TypeError(f"matchers are a mapping from names to matchers, not {matchers!r}")
    for name, matcher in matchers.items():
        if isinstance(matcher, type):
            raise TypeError(
                f"matcher {name!r} is a class, {matcher.__name__}; give an instance of it"
            )
        if not isinstance(getattr(matcher, "spec", None), MatcherSpec):
            raise TypeError(f"matcher {name!r} has no `spec` that is a MatcherSpec: {matcher!r}")
    return matchers


def require_methods(matchers: Mapping[str, Matcher[Any]]) -> None:
    """Raise ``TypeError`` if a matcher of the user cannot encode or match."""
    for name, matcher in matchers.items():
        for method in ("encode", "match"):
            if not callable(getattr(matcher, method, None)):
                raise TypeError(f"matcher {name!r} has no method `{method}`: {matcher!r}")
