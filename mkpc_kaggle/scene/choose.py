"""Choice of a pair's fundamental matrix: from the scene, or from the pair's matches.

:func:`choose` decides it. In order:

1. F of the pair's two cameras;
2. the pair's own F, if both images are one file, or its matches contradict the cameras. Of its evidence, 60 or
   more, the scene's F has less than half (the mean over the units). Or
   30 matches or more are within 2 px of it, and less than 5 % of their number within 2 px of the scene's F;
3. if the cameras give no F, since an image has none, they are in two models or at one place, or a lens is
   distorted: with ``[focal]``, F from the pair's matches at the focal lengths of the scene, else its own F.

:mod:`mkpc_kaggle.scene.candidates` chooses the scene itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from mkpc_kaggle.geometry.cameras import fundamental_of_cameras
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.focal_prior import FocalConfig, FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import RobustConfig, sampson_distances
from mkpc_kaggle.scene.models import RegisteredImage
from mkpc_kaggle.scene.view_graph import BatchPair

CONTRADICTION_ERROR_PX = 2.0  # maximum Sampson distance of a match that agrees with an F
CONTRADICTION_MATCHES = 30  # minimum number of matches that agree with the pair's F
# Minimum share of these matches that must agree with the scene's F
CONTRADICTION_SHARE = 0.05
# The scale of the evidence for an F; larger in images with a longer side
EVIDENCE_PX, EVIDENCE_SIDE = 1.0, 1536
EVIDENCE_MATCHES = 60.0  # minimum evidence for the pair's F, of all units
EVIDENCE_UNIT = 5.0  # minimum of a unit: less agrees by chance
# The scene's F must have this share of it, as the mean of the units. On eighteen draws
# shares from 0.3 to 0.7 gain.
EVIDENCE_SHARE = 0.5
FOCAL_SIGMA = 0.1  # standard deviation of the logarithm of the scene's focal lengths

# The registered images of a model, by digest
ModelImages: TypeAlias = Mapping[str, RegisteredImage]


class Reason(StrEnum):
    """Reason for a pair's :class:`Choice`; only ``SCENE`` stands for the scene's F."""

    SCENE = "both cameras are known"
    UNREGISTERED = "an image has no camera"
    APART = "the cameras are of different models"
    SAME_IMAGE = "both images are the same picture"
    SAME_CENTRE = "both cameras stand at one point"
    DISTORTED = "a lens is distorted, and F has no distortion"
    CONTRADICTION = "the pair's own matches contradict the scene"


# Not estimated again at the scene's focal lengths
KEEPS_ITS_F = Reason.SCENE, Reason.SAME_IMAGE, Reason.CONTRADICTION


@dataclass(frozen=True, eq=False)
class Choice:
    """The F chosen for a pair, (3, 3) of unit norm with x1^T F x0 = 0.

    F is the scene's, or the pair's at the scene's focal lengths. ``None`` means that the pair keeps
    its F.
    """

    F: Matrix3 | None
    reason: Reason

    @property
    def from_scene(self) -> bool:
        return self.reason is Reason.SCENE


def choose(
    pair: BatchPair,
    models: Sequence[ModelImages],
    focals: Mapping[str, float] = MappingProxyType({}),
    focal: FocalConfig | None = None,
    magsac: RobustConfig | None = None,
) -> Choice:
    """Return the F from a pair's cameras, in the first model with both cameras, or the reason for
    none.

    ``focals`` are the scene's focal lengths in pixels, by digest. With the recipe's prior ``focal``, a pair
    without an F from cameras is estimated again at these, unless it contradicts the scene.
    """
    choice = from_cameras(pair, models)
    if focal is None or choice.reason in KEEPS_ITS_F:
        return choice
    magsac = magsac or RobustConfig()
    return replace(choice, F=estimate_at_known_focals(pair, focals, focal, magsac))


def from_cameras(pair: BatchPair, models: Sequence[ModelImages]) -> Choice:
    """Return the choice between the F of a pair's cameras and its own F, see :func:`choose`."""
    digests = pair.image0.digest, pair.image1.digest
    # Two copies of a file have one camera, and no epipolar geometry.
    if digests[0] == digests[1]:
        return Choice(None, Reason.SAME_IMAGE)
    model = next((model for model in models if model.keys() >= set(digests)), None)
    if model is None:
        registered = {digest for model in models for digest in model}
        return Choice(
            None, Reason.APART if registered >= set(digests) else Reason.UNREGISTERED
        )
    if any(model[digest].has_distortion for digest in digests):
        return Choice(None, Reason.DISTORTED)
    try:
        F = fundamental_of_cameras(*(model[digest].camera for digest in digests))
    except ValueError:
        # The pair's own F may still describe the matches.
        return Choice(None, Reason.SAME_CENTRE)
    if contradicts(F, pair):
        return Choice(None, Reason.CONTRADICTION)
    return Choice(F, Reason.SCENE)


def contradicts(F: Matrix3, pair: BatchPair) -> bool:
    """Return whether a pair's matches speak against the scene's F: far fewer agree with it than with the
    pair's own F, or its evidence is far less.

    The pair's F normally agrees with more matches. On a repetitive facade, a wrong F of a few matches may agree
    with many times more of them, so only a tiny share counts against the scene. With more matches half of the
    evidence does. Each unit counts equally, as the scene's cameras may be of one unit's points.
    """
    own = pair.pair_fundamental
    if own is None:
        return False
    if _has_little_evidence(F, own, pair):
        return True
    with_scene = _agreeing(F, pair)
    with_own = _agreeing(own, pair)
    return bool(
        with_own >= CONTRADICTION_MATCHES and with_scene < CONTRADICTION_SHARE * with_own
    )


def _has_little_evidence(F: Matrix3, own: Matrix3, pair: BatchPair) -> bool:
    side = max(*pair.image0.size, *pair.image1.size)
    scale = EVIDENCE_PX * max(1.0, side / EVIDENCE_SIDE)
    for_own = np.array([evidence(own, matches, scale) for matches in pair.by_unit])
    for_scene = np.array([evidence(F, matches, scale) for matches in pair.by_unit])
    counts = for_own >= EVIDENCE_UNIT
    if for_own.sum() < EVIDENCE_MATCHES or not counts.any():
        return False
    return bool(np.mean(for_scene[counts] / for_own[counts]) < EVIDENCE_SHARE)


def evidence(F: Matrix3, matches: Matches, scale: float) -> float:
    """Return the robust number of matches that agree with F: the sum of 1 / (1 + (r / scale)^2), with
    Sampson distances r and ``scale`` in pixels.
    """
    return float(np.sum(1 / (1 + (sampson_distances(F, matches) / scale) ** 2)))


def _agreeing(F: Matrix3, pair: BatchPair) -> int:
    """Return the number of a pair's matches that agree with F."""
    distances = sampson_distances(F, pair.matches)
    return int(np.count_nonzero(distances < CONTRADICTION_ERROR_PX))


def estimate_at_known_focals(
    pair: BatchPair, focals: Mapping[str, float], config: FocalConfig, magsac: RobustConfig
) -> Matrix3 | None:
    """Return F (3, 3) from a pair's matches, with the scene's focal lengths ``focals``, in pixels
    by digest.

    Return ``None`` if neither image has a known focal length or the matches give no F.
    """
    images = pair.image0, pair.image1
    if not any(image.digest in focals for image in images):
        return None
    # An image outside the scene keeps the usual prior.
    first, second = (
        FocalPrior.of_focal(focals[image.digest], FOCAL_SIGMA, image.size)
        if image.digest in focals
        else FocalPrior.of_image(image.size, image.focal)
        for image in images
    )
    found = estimate_with_prior(pair.matches, (first, second), magsac, config)
    return found.matrix if found.ok else None
