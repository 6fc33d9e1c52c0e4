"""Digests of the settings behind each derived table, which decide whether rows are up to date.

A digest includes the version of its algorithm. Increase the version if the same settings give other results.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import cv2

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.pipeline.assembly import Assembly

POINTS, ESTIMATE, SCENE = 1, 2, 2  # versions of the algorithms


@dataclass(frozen=True)
class Settings:
    """The digests of a recipe's settings for each unit, for estimates, and for scenes."""

    units: tuple[str, ...]
    estimate: str
    scene: str

    @classmethod
    def of(cls, assembly: Assembly) -> "Settings":
        recipe = assembly.recipe
        alone = {unit: digest([POINTS, assembly.unit_settings(unit)]) for unit in recipe.units}
        first = [alone[unit] for unit in recipe.units if unit.stage == 1]
        crops = digest([asdict(recipe.mkpc), first, sorted(assembly.regions.items())])
        units = tuple(alone[unit] if unit.stage == 1 else digest([alone[unit], crops]) for unit in recipe.units)
        estimates = asdict(recipe.magsac), recipe.focal and asdict(recipe.focal), cv2.__version__
        tracks = [unit.name for unit in recipe.units if unit.tracks]
        scenes = recipe.scene and asdict(recipe.scene), tracks, *estimates, version("pycolmap")
        return cls(units, digest([ESTIMATE, *estimates]), digest([SCENE, *scenes]))

    def of_estimate(self, pair: Pair) -> str:
        """Return the digest of the settings and intrinsics that determine a pair's F or E from its points."""
        known = pair.intrinsics
        return digest([self.estimate, [K.tolist() for K in known]]) if known else self.estimate


def digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]
