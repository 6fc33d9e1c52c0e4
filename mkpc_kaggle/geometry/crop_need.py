"""Where the crop pays: a pair needs stage 2 if its two images differ in scale, or if the crop restores
detail that stage 1 shrank away.

On ordinary pairs a crop gains no more than a second whole image (docs/results.md). With a change of
scale by two or more, the crops show both images at a similar scale, which no whole image does.

``[mkpc] when = "scale"`` asks for a scale of ``min_scale`` (1.9) or a detail of ``min_detail`` (2.0);
"always" crops all pairs (:func:`pays`).
"""

from dataclasses import dataclass

import numpy as np

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.critical_region import (
    CriticalRegion,
    MkpcConfig,
    RegionReason,
    When,
)
from mkpc_kaggle.geometry.matches import Matches

MIN_SCALE_MATCHES = 8  # fewer say nothing about scale
SAMPLES = 2000  # pairs of matches
# Interquartile range of the logarithm of the ratio of distances. Correct matches of two photographs
# with a change of scale by two to four have 0.05 to 0.3, few and partly wrong ones up to 1. Matches by chance
# have more.
MAX_SPREAD = 1.0
MIN_TOLD = 1.05  # a smaller gain of detail is not worth a word


@dataclass(frozen=True)
class CropNeed:
    """Whether a unit of stage 2 runs on a pair, and the two ratios that decide it, both at least 1.

    ``scale`` is the ratio of the scales of the two images, each relative to its longer side.
    ``detail`` is how much larger the unit shows a region than stage 1 did, in stored pixels.
    """

    is_needed: bool
    scale: float = 1.0
    detail: float = 1.0

    def __str__(self) -> str:
        ratios = f"scales differ by {self.scale:.1f}"
        if self.detail >= MIN_TOLD:
            ratios += f", {self.detail:.1f} times the detail of stage 1"
        return f"{ratios}: {'crop' if self.is_needed else 'no crop'}"


def crop_need(
    regions: tuple[CriticalRegion, CriticalRegion],
    scale: float,
    whole: tuple[float, float],
    crop: tuple[float, float],
    config: MkpcConfig,
) -> CropNeed:
    """Return whether a unit of stage 2 runs on a pair with these critical regions.

    ``scale`` is :func:`scale_between` of the matches of stage 1. ``whole`` and ``crop`` are view
    pixels per image pixel, for both images: of the largest view in stage 1, and of the unit's view
    of the region. An enlarged view has no more detail than the image. Two whole images have nothing
    to gain: they were matched in stage 1.
    """
    if RegionReason.CROPPED not in {region.reason for region in regions}:
        return CropNeed(pays(1.0, 1.0, config))
    both = zip(whole, crop, strict=True)
    detail = max(1.0, *(min(1.0, after) / min(1.0, before) for before, after in both))
    return CropNeed(pays(scale, detail, config), scale, detail)


def pays(scale: float | None, detail: float | None, config: MkpcConfig) -> bool:
    """Return whether a crop pays at these ratios of a :class:`CropNeed`."""
    if config.when is When.ALWAYS or scale is None or detail is None:
        return True
    return scale >= config.min_scale or detail >= config.min_detail


def scale_between(matches: Matches, sizes: tuple[Size, Size]) -> float:
    """Return the ratio, at least 1, of the scales at which two images show their common part.

    Scales are relative to the images' longer sides, since a matcher's views have equal ones. The
    result is the median ratio of the distances between two matched points; 1 if there are too few
    matches, or if the ratios disagree, as with wrong matches.
    """
    if len(matches) < MIN_SCALE_MATCHES:
        return 1.0
    generator = np.random.default_rng(0)  # the same matches give the same result
    first, second = generator.integers(len(matches), size=(2, SAMPLES))
    distances = []
    for points, size in zip((matches.points0, matches.points1), sizes, strict=True):
        relative = points.astype(np.float64) / max(size)
        distances.append(np.linalg.norm(relative[first] - relative[second], axis=1))
    before, after = distances
    # Ratios of small distances are noise. Equal points in one image have no ratio.
    is_long = (before > np.median(before) / 2) & (after > 0)
    if not is_long.any():
        return 1.0
    low, middle, high = np.percentile(np.log(after[is_long] / before[is_long]), [25, 50, 75])
    if high - low > MAX_SPREAD:
        return 1.0
    return float(np.exp(abs(middle)))
