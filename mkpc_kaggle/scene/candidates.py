"""Candidates of a scene, from the tracks of different units, and the judge that chooses one.

Which matcher's points make the best cameras differs from scene to scene. So a batch may be
reconstructed several times: from the tracks of all units, from those on edges with enough support,
and from the tracks of each unit alone.

The judge compares the rotations between cameras with the rotations by F of single pairs, which no camera has
influenced. Wrong edges and poor keypoints bend cameras, and a pair has the matches of all units.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import fmean

from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import pose_error
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import SceneConfig, Unit
from mkpc_kaggle.scene.models import SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair, tracks_of

# Candidates with tracks of all units, on all edges or on edges with enough support
# (:func:`mkpc_kaggle.scene.view_graph.supported`); each other candidate has the name of its unit.
ALL_UNITS, SUPPORTED = "", "supported"
CANDIDATE_SUPPORT = 0.1
# A candidate's disagreement must be smaller than this share of the first one's. Shares from 0.97 to 0.99
# choose the same on all draws of docs/results.md.
MAX_SHARE = 0.98
MAX_ANGLE_DEG = 10.0  # of a pair: F of some pairs is wrong, and a pair may have no cameras


def candidates_of(units: Sequence[Unit], config: SceneConfig | None) -> tuple[str, ...]:
    """Return the candidates to try, in order; the first is used if there is no time for others."""
    names = [unit.name for unit in units if unit.tracks]
    most = config.candidates if config is not None else 1
    # A choice was measured between units only.
    others = [SUPPORTED, *names] if len(names) > 1 else []
    return (ALL_UNITS, *others)[:most]


def candidate_settings(candidate: str, config: SceneConfig) -> SceneConfig:
    """Return the settings of a candidate's reconstruction."""
    if candidate != SUPPORTED:
        return config
    return replace(config, min_support=max(config.min_support, CANDIDATE_SUPPORT))


def candidate_tracks(results: Sequence[UnitResult], candidate: str) -> Matches:
    """Return the matches of a pair that make a candidate's tracks."""
    if candidate in (ALL_UNITS, SUPPORTED):
        return tracks_of(results)
    return Matches.concatenate(
        result.matches for result in results if result.unit.name == candidate
    )


def batch_pair(
    images: tuple[BatchImage, BatchImage],
    results: Sequence[UnitResult],
    own: Matrix3 | None,
    candidate: str,
) -> BatchPair:
    """Return a pair of a batch with its points, and the tracks of a candidate."""
    by_unit = tuple(result.matches for result in results)
    return BatchPair(*images, by_unit, own, candidate_tracks(results, candidate))


def disagreement(pairs: Sequence[BatchPair], models: Sequence[SfmModel]) -> float:
    """Return the judge's value of a candidate in degrees; the lowest wins.

    It is the mean angle between the rotation of a pair's cameras and that of F of the pair by itself, over
    the pairs that have one. An angle counts up to ``MAX_ANGLE_DEG``, as does a pair without cameras in one
    of the ``models``: cameras for few images do not win.
    """
    cameras = [
        {found.image.digest: found.camera for found in model.images} for model in models
    ]
    angles = []
    for pair in pairs:
        ends = (pair.image0.digest, pair.image1.digest)
        # Two copies of a photograph have no F.
        if pair.pair_fundamental is None or ends[0] == ends[1]:
            continue
        model = next((model for model in cameras if model.keys() >= set(ends)), None)
        angle = MAX_ANGLE_DEG
        if model is not None:
            angle = rotation_between(pair.pair_fundamental, model[ends[0]], model[ends[1]])
        angles.append(min(MAX_ANGLE_DEG, angle))
    return fmean(angles) if angles else 0.0


def rotation_between(F: Matrix3, camera0: Camera, camera1: Camera) -> float:
    """Return the angle in degrees between the rotation of two cameras and the nearer one of F."""
    return pose_error(F, camera0, camera1, metres_per_unit=1.0).rotation


def best_of(values: Mapping[str, float]) -> str:
    """Return the candidate with the lowest value, if it is clearly lower than the first one's; of equal
    ones the first in the order of the mapping.
    """
    best = min(values, key=lambda name: values[name])
    first = values.get(ALL_UNITS)
    return best if first is None or values[best] < MAX_SHARE * first else ALL_UNITS


def title_of(candidate: str) -> str:
    """Return a candidate's name for reports."""
    if candidate == SUPPORTED:
        return "all units, supported edges"
    return candidate or "all units"
