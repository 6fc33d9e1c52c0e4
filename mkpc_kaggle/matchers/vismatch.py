"""Adapter of vismatch's matchers (https://github.com/gmberton/vismatch, version 1.4).

A recipe's unit names one as ``matcher = "vismatch:NAME"``. vismatch itself downloads the weights of
a matcher when it is first loaded, so the first run needs internet.

vismatch's ``get_matcher(NAME)`` returns a callable that maps two images to a dict. Its keys are
``matched_kpts0`` and ``matched_kpts1``, (N, 2) pixels (x, y) before vismatch's RANSAC, and
``matched_confidences``, (N,) or ``None``.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module, metadata
from importlib.metadata import PackageNotFoundError
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mkpc_kaggle.config import AT_LEAST_1, check_ranges
from mkpc_kaggle.geometry.coordinates import from_corner
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, PairwiseMatcher, Picture, Placement
from mkpc_kaggle.matchers.registry import VISMATCH
from mkpc_kaggle.weights import WeightStore

LICENCE = "see vismatch"  # its matchers have many licences, which it does not state as data


@dataclass(frozen=True)
class VismatchOptions:
    """The options of a unit ``vismatch:NAME``; the defaults suit keypoints in whole pixels."""

    corner: bool = False  # True: the origin of points is the image's top-left corner
    multiple: int = 1  # the sides of views are padded to multiples of this
    keypoints: int = 2048  # vismatch's max_num_keypoints

    def __post_init__(self) -> None:
        check_ranges(self, multiple=AT_LEAST_1, keypoints=AT_LEAST_1)


@dataclass(frozen=True)
class Adapter:
    """One of vismatch's matchers, with the interface of a module of ``adapters/``."""

    name: str  # vismatch's, without the prefix

    @property
    def SPEC(self) -> MatcherSpec:  # noqa: N802  the name of a module's constant
        return MatcherSpec(
            f"{VISMATCH}{self.name}", VismatchOptions, licences=(LICENCE,), version=_version()
        )

    def load(
        self, weights: WeightStore, options: VismatchOptions, placement: Placement
    ) -> "VismatchMatcher":
        vismatch = import_module("vismatch")
        matcher = vismatch.get_matcher(
            self.name, device=placement.device, max_num_keypoints=options.keypoints
        )
        return VismatchMatcher(
            matcher,
            f"{VISMATCH}{self.name}",
            corner=options.corner,
            multiple=options.multiple,
            licences=(LICENCE,),
            version=_version(),
        )


def _version() -> str:
    """Return the version of vismatch, which also decides which weights it downloads."""
    with suppress(PackageNotFoundError):
        return metadata.version("vismatch")
    return str(getattr(import_module("vismatch"), "__version__", ""))


def adapter_of(name: str) -> Adapter:
    """Return the adapter of vismatch's matcher ``name``. Raise ``ImportError`` without vismatch."""
    import_module("vismatch")
    return Adapter(name)


class VismatchMatcher(PairwiseMatcher[Picture]):
    """A vismatch matcher for :class:`mkpc_kaggle.TwoStageMatcher`; ``name`` as in a recipe.

    With ``corner``, the origin of points is the image's top-left corner, as in RoMa, DKM and LoMa;
    otherwise it is the centre of the top-left pixel. Sides are padded to multiples of ``multiple``,
    because many matchers resize other images, which makes points less accurate. Every pair is
    matched from pixels; features are not cached. A match without a confidence has the score 1.
    vismatch's estimation of a homography is switched off.
    """

    def __init__(
        self,
        matcher: Any,
        name: str = "vismatch",
        *,
        corner: bool = False,
        multiple: int = 1,
        licences: tuple[str, ...] = (),
        version: str = "",
    ) -> None:
        self.spec = MatcherSpec(name, multiple=multiple, licences=licences, version=version)
        self._matcher = matcher
        self._corner = corner
        matcher.skip_ransac = True

    def encode(self, pictures: Sequence[Picture]) -> list[Picture]:
        return list(pictures)

    def _match(self, picture0: Picture, picture1: Picture) -> Matches:
        # (3, H, W) float32 in 0..1, padding included, so the sides are multiples.
        image0 = torch.from_numpy(picture0.pixels).permute(2, 0, 1).float() / 255
        image1 = torch.from_numpy(picture1.pixels).permute(2, 0, 1).float() / 255
        found = self._matcher(image0, image1)
        points0 = self._points(found["matched_kpts0"])
        points1 = self._points(found["matched_kpts1"])
        scores = found.get("matched_confidences")
        if scores is None:
            scores = np.ones(len(points0))
        return Matches(points0, points1, np.asarray(scores, np.float32))

    def _points(self, keypoints: Any) -> NDArray[np.floating]:
        """Return vismatch's keypoints as (N, 2) view pixels; without matches it may return (0,)."""
        points = np.asarray(keypoints, np.float32).reshape(-1, 2)
        return from_corner(points) if self._corner else points
