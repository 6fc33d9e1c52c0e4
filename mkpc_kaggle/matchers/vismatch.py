"""Matchers of vismatch (https://github.com/gmberton/vismatch, version 1.4) as matchers of ours.

Its ``get_matcher(NAME)`` returns an object that is called with two images and answers with a dict.
Of that we read ``matched_kpts0`` and ``matched_kpts1``, (N, 2) pixels (x, y) before its own RANSAC, and
``matched_confidences``, (N,) or ``None``. vismatch itself is not needed here.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from mkpc_kaggle.geometry.coordinates import from_corner
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, PairwiseMatcher, Picture


class VismatchMatcher(PairwiseMatcher[Picture]):
    """Give it to :class:`mkpc_kaggle.TwoStageMatcher` under the name that the recipe's units have.

    ``corner``: the matcher counts pixels from the image's top-left corner, as RoMa, DKM and LoMa do; else from the
    centre of the top-left pixel. ``multiple``: what the sides of its images must be multiples of; where they are
    not, many matchers resize, and their points lose a little. Every pair is matched from the pixels: no features
    are kept. A match without a confidence has the score 1. The homography that vismatch fits is switched off.
    """

    def __init__(
        self,
        matcher: Any,
        name: str = "vismatch",
        *,
        corner: bool = False,
        multiple: int = 1,
        licences: tuple[str, ...] = (),
    ) -> None:
        self.spec = MatcherSpec(name, f"{name}, of vismatch", multiple=multiple, licences=licences)
        self._matcher = matcher
        self._corner = corner
        matcher.skip_ransac = True

    def encode(self, pictures: Sequence[Picture]) -> list[Picture]:
        return list(pictures)

    def _match(self, picture0: Picture, picture1: Picture) -> Matches:
        # (3, H, W) float32 in 0..1, padding included: it keeps the sides multiples of what they have to be.
        both = (torch.from_numpy(each.pixels).permute(2, 0, 1).float() / 255 for each in (picture0, picture1))
        found = self._matcher(*both)
        points = [np.asarray(found[f"matched_kpts{number}"], np.float32).reshape(-1, 2) for number in (0, 1)]
        points0, points1 = map(from_corner, points) if self._corner else points
        confidences = found.get("matched_confidences")
        scores = np.ones(len(points0), np.float32) if confidences is None else np.asarray(confidences, np.float32)
        return Matches(points0, points1, scores)
