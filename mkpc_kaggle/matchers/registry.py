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
    module = import_module(MATCHERS[name])
    with exact_float32():
        matcher: Matcher[Any] = module.load(weights, options, placement)
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
