"""Intrinsics that the user knows, in COLMAP's camera models.

Parameters have COLMAP's order and units: pixels, with (0, 0) the corner of the top-left pixel, not
its centre.
"""

import fnmatch
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from types import MappingProxyType

from mkpc_kaggle.config import decimal

# Parameters of the models that a perspective camera with a usual lens needs.
LENS_MODELS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "SIMPLE_PINHOLE": ("f", "cx", "cy"),
        "PINHOLE": ("fx", "fy", "cx", "cy"),
        "SIMPLE_RADIAL": ("f", "cx", "cy", "k"),
        "RADIAL": ("f", "cx", "cy", "k1", "k2"),
        "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
        "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    }
)


@dataclass(frozen=True)
class KnownCamera:
    """A camera model with parameters. Raises ``ValueError`` for values that no camera has."""

    model: str
    parameters: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in LENS_MODELS:
            raise ValueError(
                f"unknown camera model {self.model!r}; known: {', '.join(LENS_MODELS)}"
            )
        names = LENS_MODELS[self.model]
        if len(self.parameters) != len(names):
            raise ValueError(f"{self.model} has {len(names)} parameters ({', '.join(names)})")
        if not all(map(isfinite, self.parameters)):
            raise ValueError("a parameter is not finite")
        # One or two focal lengths come first, then the principal point; distortion may be negative.
        focal_count = sum(name.startswith("f") for name in names)
        if min(self.parameters[: focal_count + 2]) <= 0:
            raise ValueError("focal lengths and the principal point must be positive")

    @property
    def focals(self) -> tuple[float, ...]:
        """One focal length in pixels, or fx and fy."""
        return self.parameters[: LENS_MODELS[self.model].index("cx")]

    @property
    def focal(self) -> float:
        """The mean focal length in pixels."""
        return sum(self.focals) / len(self.focals)

    @property
    def principal_point(self) -> tuple[float, float]:
        """The point (cx, cy); the centre of the top-left pixel is (0.5, 0.5)."""
        x, y = self.parameters[len(self.focals) :][:2]
        return x, y

    @property
    def distortion(self) -> tuple[float, ...]:
        """The coefficients of distortion, in COLMAP's and OpenCV's order; none of a pinhole."""
        return self.parameters[len(self.focals) + 2 :]

    @property
    def without_distortion(self) -> "KnownCamera":
        """The pinhole with the same focal lengths and principal point."""
        model = "SIMPLE_PINHOLE" if len(self.focals) == 1 else "PINHOLE"
        return KnownCamera(model, (*self.focals, *self.principal_point))

    def scaled(self, x: float, y: float) -> "KnownCamera":
        """Return the camera of pictures that are ``x`` times as wide and ``y`` times as high."""
        # A single focal length gets the mean, since x and y then differ by rounding.
        factors = [(x + y) / 2] if len(self.focals) == 1 else [x, y]
        factors += [x, y]
        # Distortion has no unit, so it stays.
        factors += [1.0] * (len(self.parameters) - len(factors))
        values = [value * factor for value, factor in zip(self.parameters, factors, strict=True)]
        return replace(self, parameters=tuple(values))


def radial_factor(camera: KnownCamera, radius: float) -> float:
    """Return by how much a lens magnifies a ray at ``radius``, the tangent of its angle with the axis:
    1 without distortion.
    """
    # COLMAP's and OpenCV's order: k1, k2, p1, p2, k3 to k6. The tangential p1 and p2 are left out.
    k = [*camera.distortion, *[0.0] * (8 - len(camera.distortion))]
    r2 = radius**2
    numerator = 1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3
    return numerator / (1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3)


WILD = frozenset("*?[")  # in a pattern
Rows = Sequence[tuple[str, KnownCamera]]  # a name or a pattern of images, and their camera


def parse_row(pattern: str, model: str, parameters: str) -> tuple[str, KnownCamera]:
    """Return a row of a table from its cells. Raises ``ValueError`` with the reason."""
    if not pattern.strip():
        raise ValueError("the name of the image is missing")
    values = tuple(decimal(part) for part in parameters.split(" ") if part)
    return pattern.strip(), KnownCamera(model.strip(), values)


class CameraTable:
    """Finds the row that names an image, without a look at each row: both may be thousands.

    A row names an image by path, by file name, or by a pattern of these. The first such row counts.
    """

    def __init__(self, rows: Rows) -> None:
        self.rows = rows
        # The first row with each text
        self._texts: dict[str, int] = {}
        self._patterns: list[tuple[int, str]] = []
        for number, (written, _) in enumerate(rows):
            text = _composed(written)
            # A file may be called "photo [1].jpg", and as a pattern this is another.
            self._texts.setdefault(text, number)
            if WILD.intersection(text):
                self._patterns.append((number, text))

    def row_of(self, *names: str) -> int | None:
        """Return the number of the first row that names an image by one of its ``names``, or None."""
        numbers = []
        for path in map(_composed, names):
            base = path.rpartition("/")[2]
            numbers += [self._texts.get(path), self._texts.get(base)]
            fitting = (
                number
                for number, pattern in self._patterns
                if fnmatch.fnmatchcase(path, pattern) or fnmatch.fnmatchcase(base, pattern)
            )
            numbers.append(next(fitting, None))
        return min((number for number in numbers if number is not None), default=None)

    def camera_of(self, *names: str) -> KnownCamera | None:
        """Return the camera of the first row that names an image by one of its ``names``, or None."""
        number = self.row_of(*names)
        return None if number is None else self.rows[number][1]


def _composed(text: str) -> str:
    """Return the text with composed letters: macOS writes "é" as two characters, most tables as one."""
    return unicodedata.normalize("NFC", text)
