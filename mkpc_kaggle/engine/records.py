"""Results as the store has them: a row for the points of a unit, JSON for estimates and scenes."""

import json
from base64 import b64decode, b64encode
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion
from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.scene.candidates import ALL_UNITS
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.models import Reconstruction, RegisteredImage, SfmModel, models_of
from mkpc_kaggle.scene.view_graph import BatchImage

NOT_RECONSTRUCTED = "not reconstructed yet"
NO_CAMERAS = "no matches connect its images"
MAX_DRAWN_POINTS = 5000  # of a model, which are 60 kB in the store and enough for a picture


# Points


def points_row(
    key: str,
    found: UnitResult,
    regions: Sequence[CriticalRegion],
    decode_seconds: float,
    cluster_seconds: float,
) -> tuple[Any, ...]:
    """Return the row of a unit's points on a pair. A unit that the pair does not need has no data."""
    need = found.need
    boxes = [
        [*vars(region.box).values(), region.reason, region.clusters, region.kept]
        for region in regions
    ]
    return (
        key,
        len(found.matches),
        found.keypoints,
        decode_seconds,
        found.encode_seconds,
        found.match_seconds,
        cluster_seconds,
        None if need is None else need.scale,
        None if need is None else need.detail,
        json.dumps(boxes) if boxes else "",
        found.note,
        to_bytes(found.matches) if found.is_needed else None,
    )


def to_bytes(matches: Matches) -> bytes:
    """Return the bytes of x0, y0, x1, y1 and score of each match, as little-endian float32."""
    # Exact, because workers return float32.
    columns = [matches.points0, matches.points1, matches.scores]
    return np.column_stack(columns).astype("<f4").tobytes()


def from_bytes(data: bytes) -> Matches:
    """Invert :func:`to_bytes`."""
    table = np.frombuffer(data, "<f4").reshape(-1, 5)
    return Matches(table[:, :2], table[:, 2:4], table[:, 4])


# Scenes


@dataclass(frozen=True)
class Rival:
    """A candidate of a scene that was not chosen: its disagreement and its number of registered images."""

    candidate: str
    disagreement: float
    registered: int


@dataclass(frozen=True)
class SceneRecord:
    """The reconstruction of a batch: numbers of images, registered images and points, and the
    models.

    The largest model comes first. Each model has up to ``MAX_DRAWN_POINTS`` of its points, of the
    longest tracks, rounded to float32. Without a model, ``failure`` is the reason. ``choices`` has
    the choice for each pair, by the contents of its images (:func:`mkpc_kaggle.engine.keys.contents_of`).

    ``candidate`` states whose tracks were used, with its ``disagreement`` in degrees; ``rivals`` are the other
    candidates, the best first, which are scenes of their own in the store. ``key`` is that of the stored scene.
    """

    batch: str
    images: int = 0
    registered: int = 0
    points: int = 0
    seconds: float = 0.0
    failure: str = ""
    models: tuple[SfmModel, ...] = field(default=(), compare=False)
    choices: Mapping[str, Choice] = field(default_factory=dict, compare=False)
    candidate: str = ALL_UNITS
    disagreement: float = 0.0
    key: str = field(default="", compare=False)
    rivals: tuple[Rival, ...] = ()

    @classmethod
    def of(
        cls,
        batch: str,
        reconstructions: Sequence[Reconstruction],
        seconds: float = 0.0,
        **more: Any,
    ) -> "SceneRecord":
        """Return the record of a batch's reconstructions; ``more`` are other fields."""
        models = models_of(reconstructions)
        reasons = dict.fromkeys(found.failure for found in reconstructions if found.failure)
        return cls(
            batch,
            images=sum(len(found.names) for found in reconstructions),
            registered=sum(found.registered for found in reconstructions),
            points=sum(len(model.points) for model in models),
            seconds=seconds,
            failure="" if models else "; ".join(reasons) or NO_CAMERAS,
            models=tuple(replace(model, points=_drawn(model.points)) for model in models),
            **more,
        )

    def against(self, others: Iterable["SceneRecord"]) -> "SceneRecord":
        """Return the record of the chosen candidate, with the others as rivals."""
        rivals = [Rival(each.candidate, each.disagreement, each.registered) for each in others]
        # The sort is stable: of equals, the former candidate first.
        rivals.sort(key=lambda rival: rival.disagreement)
        return replace(self, rivals=tuple(rivals))


def unmatched_scene(batch: str, images: Collection[str]) -> SceneRecord:
    """Return the record of a batch whose images have no matches. It is not stored, as no scene is
    computed.
    """
    return SceneRecord(batch, images=len(images), failure=NO_CAMERAS)


def _drawn(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points to store, rounded, so that a record is the same after it is read."""
    return points[:MAX_DRAWN_POINTS].astype(np.float32).astype(np.float64)


def scene_facts(record: SceneRecord) -> str:
    """Return a scene as JSON, without its rivals and its key."""
    facts = {name: value for name, value in vars(record).items() if name not in ("rivals", "key")}
    facts["models"] = [
        {
            "images": [_image_facts(found) for found in model.images],
            # 16 characters a point; as decimal digits, they would be most of a large store.
            "points": b64encode(model.points.astype("<f4").tobytes()).decode("ascii"),
            "reprojection_error": float(model.reprojection_error),
        }
        for model in record.models
    ]
    facts["choices"] = {
        contents: [None if choice.F is None else choice.F.tolist(), choice.reason]
        for contents, choice in record.choices.items()
    }
    return json.dumps(facts)


def _image_facts(found: RegisteredImage) -> dict[str, Any]:
    image = found.image
    lens = found.lens
    return {
        "image": [image.name, image.digest, list(image.size), image.focal],
        "points": found.points,
        "K": found.camera.K.tolist(),
        "R": found.camera.R.tolist(),
        "t": found.camera.t.tolist(),
        "lens": None if lens is None else [lens.model, list(lens.parameters)],
    }


def scene_of(key: str, text: str) -> SceneRecord:
    """Invert :func:`scene_facts`."""
    facts = json.loads(text)
    facts["models"] = tuple(map(_model_of, facts["models"]))
    facts["choices"] = {
        contents: Choice(None if F is None else np.array(F), Reason(reason))
        for contents, (F, reason) in facts["choices"].items()
    }
    return SceneRecord(**facts, key=key)


def _model_of(facts: Mapping[str, Any]) -> SfmModel:
    images = []
    for each in facts["images"]:
        name, digest, size, focal = each["image"]
        camera = Camera(*(np.array(each[part], float) for part in ("K", "R", "t")))
        lens = each["lens"] and KnownCamera(each["lens"][0], tuple(each["lens"][1]))
        image = BatchImage(name, digest, Size(*size), focal)
        images.append(RegisteredImage(image, camera, each["points"], lens=lens))
    points = np.frombuffer(b64decode(facts["points"]), "<f4").reshape(-1, 3).astype(np.float64)
    return SfmModel(tuple(images), points, facts["reprojection_error"])
