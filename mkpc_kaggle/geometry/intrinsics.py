"""Intrinsics that the user knows, in COLMAP's camera models.

Parameters have COLMAP's order and units: pixels, with (0, 0) the corner of the top-left pixel, not
its centre.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

# Parameters of COLMAP's models of usual lenses, the last ones fisheyes
LENS_MODELS: Mapping[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}


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
    def has_distortion(self) -> bool:
        """Whether F of the camera does not fit the pixels, as of any fisheye."""
        return "FISHEYE" in self.model or any(self.parameters[len(self.focals) + 2 :])


# The path of an image below its folder, and its camera
Rows = Sequence[tuple[str, KnownCamera]]
