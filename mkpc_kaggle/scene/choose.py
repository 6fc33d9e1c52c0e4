"""Which fundamental matrix a pair gets: the scene's, or the one that its own matches gave."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras, mean_cameras
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Matrix3, sampson_distances
from mkpc_kaggle.scene.config import SceneConfig
from mkpc_kaggle.scene.model import Model, PlacedImage


class Reason(StrEnum):
    """Why a pair has the F that it has; the first alone means the scene's."""

    SCENE = "both cameras are known"
    UNPLACED = "an image has no camera"
    APART = "the cameras are of different models"
    SAME_IMAGE = "both images are the same picture"
    SAME_CENTRE = "both cameras stand at one point"
    CONTRADICTION = "the pair's own matches contradict the scene"


@dataclass(frozen=True, eq=False)
class Choice:
    """``F`` is the scene's, (3, 3) of unit norm with x1^T F x0 = 0, or that of the pair's own matches at the focal
    lengths that the scene found; ``None`` where the pair keeps the F that it had.
    """

    F: Matrix3 | None
    reason: Reason

    @property
    def from_scene(self) -> bool:
        return self.reason is Reason.SCENE


def choose(
    reconstructions: Sequence[Sequence[Model]],
    image0: str,
    image1: str,
    matches: Matches,
    own: Matrix3 | None,
    config: SceneConfig,
) -> Choice:
    """The F of a pair, from the mean of its cameras in all reconstructions of the batch that have both.

    A reconstruction is several models; the first that has both images counts. What is far from the first
    reconstruction's is left out, see :func:`mkpc_kaggle.geometry.cameras.mean_cameras`. ``own`` is what the pair's
    ``matches`` alone gave, ``None`` if nothing.
    """
    if image0 == image1:
        return Choice(None, Reason.SAME_IMAGE)
    found = [both for models in reconstructions if (both := cameras_in(models, image0, image1))]
    if not found:
        placed = {image.name for models in reconstructions for model in models for image in model.images}
        return Choice(None, Reason.APART if {image0, image1} <= placed else Reason.UNPLACED)
    try:
        F = fundamental_of_cameras(*(found[0] if len(found) == 1 else mean_cameras(found, config.agreement)))
    except ValueError:
        return Choice(None, Reason.SAME_CENTRE)
    if own is not None and contradicts(F, own, matches, config):
        return Choice(None, Reason.CONTRADICTION)
    return Choice(F, Reason.SCENE)


def cameras_in(models: Sequence[Model], image0: str, image1: str) -> tuple[Camera, Camera] | None:
    """Those of two images in the first model that has both."""
    for model in models:
        first, second = placed_in(model, image0), placed_in(model, image1)
        if first and second:
            return first.camera, second.camera
    return None


def contradicts(F: Matrix3, own: Matrix3, matches: Matches, config: SceneConfig) -> bool:
    """Whether far fewer of the pair's matches agree with the scene's F than with its own.

    To agree is to be within ``contradiction_error`` pixels by Sampson's distance. A pair's own F always has more
    of its own matches, and on a facade that repeats itself it may have many times as many and be wrong: only next
    to none counts against the scene.
    """
    with_own, with_scene = (
        np.count_nonzero(sampson_distances(matrix, matches) < config.contradiction_error) for matrix in (own, F)
    )
    return bool(with_own >= config.contradiction_matches and with_scene < config.contradiction_share * with_own)


def placed_in(model: Model, name: str) -> PlacedImage | None:
    return next((image for image in model.images if image.name == name), None)
