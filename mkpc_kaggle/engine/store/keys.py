"""Keys: the digest of everything that a result was computed from.

A result is up to date exactly if it is stored under the key that a computation today would have.
Nothing else says so. Each kind has a version of its algorithm: increase it if the same inputs give
other results. ``POINTS_VERSION`` is that of all matchers of the package. A matcher that a user gives
in Python has its own, ``MatcherSpec.version``.
"""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import cv2

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.masks import Masks
from mkpc_kaggle.geometry.critical_region import When
from mkpc_kaggle.matchers.contract import Precision
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.scene.view_graph import BatchImage

# Versions of the algorithms, each in the digests of its kind. With a wrong version, old results would
# pass as today's, which no later check notices.
POINTS_VERSION = 3
ESTIMATE_VERSION = 4
SCENE_VERSION = 13
RULE_VERSION = 2

# Settings of [mkpc] that decide whether a crop is matched, and not what is found in it.
RULE = ("when", "min_scale", "min_detail")

Images = tuple[BatchImage, BatchImage]


def digest(value: Any) -> str:
    """Return the digest of a value of JSON types, as 32 hexadecimal digits."""
    # Sorted, since the order of a TOML file's keys means nothing. Paths and enums are texts.
    text = json.dumps(value, sort_keys=True, default=str)
    return hashlib.blake2b(text.encode("utf-8", "backslashreplace"), digest_size=16).hexdigest()


def text_digest(lines: Iterable[str]) -> str:
    """Return the digest of texts without line breaks, much faster than :func:`digest`."""
    text = "\n".join(lines)
    return hashlib.blake2b(text.encode("utf-8", "backslashreplace"), digest_size=16).hexdigest()


@dataclass(frozen=True)
class Keys:
    """The keys of a recipe's results, from digests of its settings.

    ``units`` has a digest for each unit, in the recipe's order. ``float32`` has the digests of units
    that ran in float32 although the run was given half precision: on the CPU that took over, or
    after an overflow. ``masks`` are of single images.
    """

    units: tuple[str, ...]
    mkpc: str = ""
    rule: str = ""  # that says which pairs need their crops; empty: all of them
    estimate: str = ""
    scene: str = ""
    masks: Masks = field(default_factory=Masks)
    float32: tuple[str, ...] = ()  # empty: the same

    @classmethod
    def of(cls, assembly: Assembly) -> "Keys":
        recipe = assembly.recipe
        units = tuple(
            digest([POINTS_VERSION, assembly.unit_settings(unit)]) for unit in recipe.units
        )
        exact = Precision.FLOAT32
        float32 = [
            digest([POINTS_VERSION, assembly.unit_settings(unit, exact)]) for unit in recipe.units
        ]
        # All settings of a table: a new setting changes the keys, which costs a rerun but no wrong result.
        magsac = asdict(recipe.magsac)
        focal = recipe.focal and asdict(recipe.focal)
        # MAGSAC comes from OpenCV, and other versions of it may give another F.
        estimate = digest([ESTIMATE_VERSION, magsac, focal, cv2.__version__])
        # The number of candidates does not change any of them.
        scene = recipe.scene and asdict(replace(recipe.scene, candidates=1))
        mkpc = asdict(recipe.mkpc)
        cameras = [[pattern, asdict(camera)] for pattern, camera in assembly.cameras]
        # The units that make tracks: a unit's points do not depend on it, but scenes do.
        tracks = [unit.name for unit in recipe.units if unit.tracks]
        return cls(
            units,
            digest({name: value for name, value in mkpc.items() if name not in RULE}),
            ""
            if recipe.mkpc.when is When.ALWAYS
            else digest([RULE_VERSION, *(mkpc[name] for name in RULE)]),
            estimate,
            digest([SCENE_VERSION, scene, cameras, tracks, estimate, _mapper_version()]),
            assembly.masks,
            tuple(float32),
        )

    def of_points(
        self,
        unit: int,
        pair: Pair,
        images: Images,
        first: Sequence[str],
        *,
        is_float32: bool = False,
    ) -> str:
        """Return the key of a unit's points on a pair, in the given precision or in float32.

        ``first`` are the keys of the points that the pair's crops come from; empty for a unit of stage 1.
        """
        image0, image1 = images
        turns = map(str, pair.turns)
        # A pair without masks has the key that it would have without the option.
        masks = [self.masks.digest(file) for file in (pair.file0, pair.file1)]
        masked = ["masks", *masks] if any(masks) else []
        units = self.float32 if is_float32 and self.float32 else self.units
        return text_digest([units[unit], image0.digest, image1.digest, *turns, *masked, *first])

    def unneeded(self, points: str) -> str:
        """Return the key of the answer that a pair does not need the unit with these points."""
        return text_digest([self.rule, points])

    def crops_of(self, first: Sequence[str]) -> list[str]:
        """Return what decides a pair's crops: [mkpc] and the keys of its points of stage 1."""
        return [self.mkpc, *first]

    def of_estimate(self, pair: Pair, points: Sequence[str]) -> str:
        """Return the key of a pair's estimate from its points, in the recipe's order."""
        # As bytes, because a decimal text may not name each float exactly.
        known = [] if pair.intrinsics is None else [K.tobytes().hex() for K in pair.intrinsics]
        return text_digest([self.estimate, *known, "points", *points])

    def of_scene(self, inputs: Sequence[Sequence[Any]]) -> str:
        """Return the key of a scene. Each input is a pair: names, digests, keys of its points and
        estimate.
        """
        # The key includes names: images with equal contents are one image of a scene, with one name.
        return digest([self.scene, inputs])


def _mapper_version() -> str:
    """Return the version of pycolmap; empty without it: pairs need none."""
    try:
        return version("pycolmap")
    except PackageNotFoundError:
        return ""


def of_candidate(scene: str, candidate: str) -> str:
    """Return the key of a batch's candidate; ``scene`` is that of the first, from all units."""
    return text_digest([scene, candidate]) if candidate else scene
