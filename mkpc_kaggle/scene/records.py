"""The scene of a batch as plain facts, which a store has as JSON."""

import json
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from mkpc_kaggle.scene.candidates import ALL_UNITS
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.models import Reconstruction, RegisteredImage, models_of

NOT_RECONSTRUCTED = "not reconstructed yet"
NO_CAMERAS = "no matches connect its images"
MAX_DRAWN_POINTS = 5000  # of a model, which are 80 kB in the store and enough for a picture
# Columns of ``SceneRecord.cameras``
CAMERAS = ["model", "image", "digest", "width", "height", "focal", "points", "K", "R", "t"]
CAMERAS += ["camera_model", "parameters"]


@dataclass(frozen=True)
class SceneRecord:
    """The reconstruction of a batch: numbers of images, of images with a camera and of points, and the mean
    reprojection error in pixels. Without a camera, ``failure`` is the reason.

    ``cameras`` has a row for each camera of each model, with lists for arrays. ``clouds`` has points of each
    model, those of the longest tracks, as base64 of little-endian float32 (P, 3). ``choices`` has the choice for
    each pair, by the contents of its images (:func:`mkpc_kaggle.engine.keys.contents_of`). ``candidate`` states
    whose tracks were used, with its ``disagreement`` in degrees. ``key`` is that of the stored scene.
    """

    batch: str
    images: int = 0
    registered: int = 0
    points: int = 0
    reprojection_error: float = np.nan
    seconds: float = 0.0
    failure: str = ""
    cameras: Sequence[Sequence[Any]] = ()
    clouds: Sequence[str] = ()
    choices: Mapping[str, Choice] = field(default_factory=dict)
    candidate: str = ALL_UNITS
    disagreement: float = 0.0
    key: str = ""

    @classmethod
    def of(cls, batch: str, reconstructions: Sequence[Reconstruction], **more: Any) -> Self:
        """Return the record of a batch's reconstructions; ``more`` are other fields."""
        models = models_of(reconstructions)
        reasons = dict.fromkeys(found.failure for found in reconstructions if found.failure)
        errors = [model.reprojection_error for model in models]
        # A model without points has no error, and a weight that is not 0: the sum must not vanish.
        weights = [max(1, sum(image.points for image in model.images)) for model in models]
        return cls(
            batch,
            images=sum(len(found.names) for found in reconstructions),
            registered=sum(found.registered for found in reconstructions),
            points=sum(len(model.points) for model in models),
            reprojection_error=float(np.average(errors, weights=weights))
            if models
            else np.nan,
            failure="" if models else "; ".join(reasons) or NO_CAMERAS,
            cameras=[
                _camera_row(number, image)
                for number, model in enumerate(models)
                for image in model.images
            ],
            # 16 characters a point; as decimal digits, they would be most of a large store.
            clouds=[
                b64encode(model.points[:MAX_DRAWN_POINTS].astype("<f4").tobytes()).decode()
                for model in models
            ],
            **more,
        )

    def to_json(self) -> str:
        choices = {
            contents: (None if choice.F is None else choice.F.tolist(), choice.reason)
            for contents, choice in self.choices.items()
        }
        return json.dumps({**vars(self), "choices": choices})

    @classmethod
    def from_json(cls, text: str) -> Self:
        facts = json.loads(text)
        facts["choices"] = {
            contents: Choice(None if F is None else np.array(F), Reason(reason))
            for contents, (F, reason) in facts["choices"].items()
        }
        return cls(**facts)


def _camera_row(model: int, found: RegisteredImage) -> tuple[Any, ...]:
    """Return the facts of a camera in the order of ``CAMERAS``."""
    image = found.image
    camera = found.camera
    lens = ("", ()) if found.lens is None else (found.lens.model, found.lens.parameters)
    matrices = (camera.K.tolist(), camera.R.tolist(), camera.t.tolist())
    return (
        model,
        image.name,
        image.digest,
        *image.size,
        found.focal,
        found.points,
        *matrices,
        *lens,
    )
