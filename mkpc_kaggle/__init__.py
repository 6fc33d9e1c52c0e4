"""Offline two-stage image matching with Matching Key-Points Crop (MKPC).

The method: :class:`TwoStageMatcher` matches a pair, :func:`critical_region` crops an image by
MKPC, and :class:`MatcherSpec` with :class:`PairwiseMatcher` begin a custom matcher.

Importing this package is cheap and has no side effect: no torch, no network, no global switch. The
names below are imported when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mkpc_kaggle.version import __version__

if TYPE_CHECKING:
    from mkpc_kaggle.engine.frames import results
    from mkpc_kaggle.errors import UserError
    from mkpc_kaggle.geometry.coordinates import Box, Size
    from mkpc_kaggle.geometry.critical_region import (
        CriticalRegion,
        MkpcConfig,
        critical_region,
    )
    from mkpc_kaggle.geometry.matches import Matches
    from mkpc_kaggle.geometry.robust import Estimate, ModelKind
    from mkpc_kaggle.matchers.contract import Colour, MatcherSpec, PairwiseMatcher, Picture
    from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
    from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
    from mkpc_kaggle.recipe import Recipe, Unit
    from mkpc_kaggle.reconstruction.run import reconstruct

__all__ = [
    "Box",
    "Colour",
    "CriticalRegion",
    "Estimate",
    "MatcherSpec",
    "Matches",
    "MkpcConfig",
    "ModelKind",
    "PairMatch",
    "PairwiseMatcher",
    "Picture",
    "Recipe",
    "Size",
    "TwoStageMatcher",
    "Unit",
    "UnitResult",
    "UserError",
    "__version__",
    "critical_region",
    "reconstruct",
    "results",
]

# Imported on first use: torch alone takes seconds.
_MODULES = {
    "TwoStageMatcher": "pipeline.two_stage",
    "PairMatch": "pipeline.pair",
    "UnitResult": "pipeline.pair",
    "Estimate": "geometry.robust",
    "ModelKind": "geometry.robust",
    "Matches": "geometry.matches",
    "critical_region": "geometry.critical_region",
    "CriticalRegion": "geometry.critical_region",
    "MkpcConfig": "geometry.critical_region",
    "Box": "geometry.coordinates",
    "Size": "geometry.coordinates",
    "Recipe": "recipe",
    "Unit": "recipe",
    "MatcherSpec": "matchers.contract",
    "PairwiseMatcher": "matchers.contract",
    "Picture": "matchers.contract",
    "Colour": "matchers.contract",
    "reconstruct": "reconstruction.run",
    "results": "engine.frames",
    "UserError": "errors",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names, for completion; without this, only the imported ones."""
    return sorted({*globals(), *__all__})
