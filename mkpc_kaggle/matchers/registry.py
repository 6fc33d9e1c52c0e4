"""The registry of matchers: names, and the modules with their ``SPEC`` and ``load``."""

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Matcher, MatcherSpec, Placement
from mkpc_kaggle.matchers.dtypes import exact_float32
from mkpc_kaggle.weights import WeightStore

NAMES = (
    "aliked",
    "aliked_lightglue",
    "aspanformer",
    "disk_lightglue",
    "dkm",
    "loftr",
    "loma",
    "quadtree",
    "roma",
    "sift",
    "sift_lightglue",
    "superglue",
    "superpoint_lightglue",
    "xfeat_lighterglue",
)
# Imported on first use: torch and kornia take seconds.
MATCHERS = {name: f"mkpc_kaggle.matchers.adapters.{name}" for name in NAMES}


def spec_of(name: str, where: str) -> MatcherSpec:
    """Import a matcher and return its spec.

    Error messages start with ``where``, the source of the name. Raises :class:`UserError` for an
    unknown name.
    """
    if name not in MATCHERS:
        raise UserError(f"{where}: unknown matcher {name!r}; known: {', '.join(MATCHERS)}")
    spec: MatcherSpec = import_module(MATCHERS[name]).SPEC
    return spec


def load_matcher(
    name: str, weights: WeightStore, options: Any, placement: Placement
) -> Matcher[Any]:
    """Return the matcher, ready to run.

    Raises :class:`UserError` if its weights are missing or damaged.
    """
    with exact_float32():
        matcher: Matcher[Any] = import_module(MATCHERS[name]).load(
            weights, options, placement
        )
    return matcher


def require_matchers(matchers: Mapping[str, Matcher[Any]]) -> None:
    """Raise ``TypeError`` unless the user's matchers are ready ones by their names."""
    for name, matcher in matchers.items():
        has_spec = isinstance(getattr(matcher, "spec", None), MatcherSpec)
        if isinstance(matcher, type) or not has_spec:
            raise TypeError(
                f"matcher {name!r} is {matcher!r}; expected an instance with `spec`, a MatcherSpec"
            )
