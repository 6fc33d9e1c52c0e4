"""Offline two-stage image matching with Matching Key-Points Crop (MKPC).

Importing this package is cheap and has no side effect: no torch, no network, no global switch. The
names below are imported when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mkpc_kaggle.version import __version__

if TYPE_CHECKING:
    from mkpc_kaggle.errors import UserError
    from mkpc_kaggle.pipeline.pair import PairMatch
    from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
    from mkpc_kaggle.recipe import Recipe
    from mkpc_kaggle.reconstruction.python import reconstruct
    from mkpc_kaggle.reporting.notebook import results

__all__ = [
    "PairMatch",
    "Recipe",
    "TwoStageMatcher",
    "UserError",
    "__version__",
    "reconstruct",
    "results",
]

# Imported on first use: torch alone takes seconds.
_MODULES = {
    "PairMatch": "pipeline.pair",
    "TwoStageMatcher": "pipeline.two_stage",
    "Recipe": "recipe",
    "UserError": "errors",
    "reconstruct": "reconstruction.python",
    "results": "reporting.notebook",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from mkpc_kaggle.errors import require_libraries

    # One line instead of pages if OpenCV does not fit NumPy.
    require_libraries()
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
