"""Values as JSON for the store: a codec converts a value to JSON values, and back.

The tables at the end name every stored field of each type. A field that is not named there gets its
default when it is read.
"""

from base64 import b64decode, b64encode
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.geometry.robust import EstimateStats
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.models import (
    Comparison,
    DistortedLens,
    FocalContradiction,
    FocalSource,
    RegisteredImage,
    SfmModel,
    Sigmas,
)
from mkpc_kaggle.scene.view_graph import BatchImage

T = TypeVar("T")


@dataclass(frozen=True)
class Codec(Generic[T]):
    """The two directions of a conversion; ``of_json(to_json(value))`` equals the value."""

    to_json: Callable[[T], Any]
    of_json: Callable[[Any], T]


def record(kind: Callable[..., T], /, **fields: Codec[Any]) -> Codec[T]:
    """Return the codec of a dataclass or named tuple: an object with these fields."""

    def to_json(value: T) -> dict[str, Any]:
        return {name: codec.to_json(getattr(value, name)) for name, codec in fields.items()}

    def of_json(about: Any) -> T:
        return kind(**{name: codec.of_json(about[name]) for name, codec in fields.items()})

    return Codec(to_json, of_json)


def several(codec: Codec[T]) -> Codec[tuple[T, ...]]:
    return Codec(
        lambda values: [codec.to_json(value) for value in values],
        lambda about: tuple(codec.of_json(each) for each in about),
    )


def by_name(codec: Codec[T]) -> Codec[dict[str, T]]:
    return Codec(
        lambda values: {name: codec.to_json(value) for name, value in values.items()},
        lambda about: {name: codec.of_json(each) for name, each in about.items()},
    )


def optional(codec: Codec[T]) -> Codec[T | None]:
    return Codec(
        lambda value: None if value is None else codec.to_json(value),
        lambda about: None if about is None else codec.of_json(about),
    )


def enum(kind: type[StrEnum]) -> Codec[Any]:
    return Codec(str, kind)


def array(*shape: int) -> Codec[NDArray[np.float64]]:
    """Return the codec of a float64 array of this shape: a flat list, which is exact in JSON."""
    return Codec(
        lambda values: values.ravel().tolist(),
        lambda about: np.array(about, float).reshape(shape),
    )


# 16 characters a point; as decimal digits, the points would be most of a large store.
POINTS_3D: Codec[NDArray[np.float64]] = Codec(
    lambda points: b64encode(points.astype("<f4").tobytes()).decode("ascii"),
    lambda text: np.frombuffer(b64decode(text), "<f4").reshape(-1, 3).astype(np.float64),
)

PLAIN: Codec[Any] = Codec(lambda value: value, lambda about: about)  # JSON types
FLOAT: Codec[float] = Codec(float, float)  # also for NumPy's float32, which json refuses
MATRIX = array(3, 3)

# The stored fields of each type

SIZE = record(Size, width=PLAIN, height=PLAIN)
BOX = record(Box, left=PLAIN, top=PLAIN, right=PLAIN, bottom=PLAIN)
REGION = record(CriticalRegion, box=BOX, reason=enum(RegionReason), clusters=PLAIN, kept=PLAIN)
STATS = record(
    EstimateStats,
    candidates=PLAIN,
    cost=FLOAT,
    magsac_cost=FLOAT,
    focals=several(FLOAT),
    support=FLOAT,
    rotation=several(FLOAT),
    plane=FLOAT,
)
CHOICE = record(Choice, F=optional(MATRIX), reason=enum(Reason))
IMAGE = record(BatchImage, name=PLAIN, digest=PLAIN, size=SIZE, focal=PLAIN)
CAMERA = record(Camera, K=MATRIX, R=MATRIX, t=array(3))
# Unknown errors of a camera are an empty tuple.
SIGMAS: Codec[Sigmas | tuple[()]] = Codec(list, lambda about: Sigmas(*about) if about else ())
KNOWN_CAMERA = record(KnownCamera, model=PLAIN, parameters=several(FLOAT), sigma=FLOAT)
REGISTERED_IMAGE = record(
    RegisteredImage,
    image=IMAGE,
    camera=CAMERA,
    points=PLAIN,
    sigmas=SIGMAS,
    lens=optional(KNOWN_CAMERA),
)
NAMES = several(PLAIN)
COMPARISON = record(
    Comparison,
    focals=several(
        record(
            FocalContradiction, source=enum(FocalSource), images=NAMES, given=FLOAT, fitted=FLOAT
        )
    ),
    lenses=several(record(DistortedLens, images=NAMES, displacement=FLOAT, camera=KNOWN_CAMERA)),
    has_moved=PLAIN,
)
MODEL = record(
    SfmModel,
    images=several(REGISTERED_IMAGE),
    points=POINTS_3D,
    reprojection_error=FLOAT,
    comparison=COMPARISON,
)
