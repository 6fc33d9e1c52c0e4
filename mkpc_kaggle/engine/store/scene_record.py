"""The scene of a batch, as the store has it and as reports show it."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.scene.candidates import ALL_UNITS
from mkpc_kaggle.scene.choose import Choice
from mkpc_kaggle.scene.models import Reconstruction, SfmModel, models_of

NOT_RECONSTRUCTED = "not reconstructed yet"
NO_CAMERAS = "no matches connect its images"
MIN_PAIRS = 2  # of a batch that is reconstructed: the minimum to connect three images
MAX_DRAWN_POINTS = 5000  # of a model, which are 60 kB in the store and enough for a picture


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
    the choice for each pair, by the contents of its images (:func:`contents_of`).

    ``candidate`` states whose tracks were used, with its ``disagreement`` in degrees; ``rivals`` are the other
    candidates, the best first. The store has them as scenes.

    ``key`` is that of the stored scene.
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
    rivals: tuple[Rival, ...] = field(default=(), metadata={"is_stored": False})

    @classmethod
    def of(
        cls,
        batch: str,
        reconstructions: Sequence[Reconstruction],
        seconds: float = 0.0,
        choices: Mapping[str, Choice] | None = None,
        candidate: str = ALL_UNITS,
        disagreement: float = 0.0,
        key: str = "",
    ) -> "SceneRecord":
        models = models_of(reconstructions)
        reasons = dict.fromkeys(
            reconstruction.failure for reconstruction in reconstructions if reconstruction.failure
        )
        return cls(
            batch,
            images=sum(len(reconstruction.names) for reconstruction in reconstructions),
            registered=sum(reconstruction.registered for reconstruction in reconstructions),
            points=sum(len(model.points) for model in models),
            seconds=seconds,
            failure="" if models else "; ".join(reasons) or NO_CAMERAS,
            models=tuple(replace(model, points=_drawn(model.points)) for model in models),
            choices=choices or {},
            candidate=candidate,
            # Later digits vary between processors
            disagreement=float(f"{disagreement:.6g}"),
            key=key,
        )

    @property
    def loose(self) -> int:
        """Number of images whose only cameras are in loose models (:attr:`SfmModel.is_loose`)."""
        sure = {found.image.name for m in self.models if not m.is_loose for found in m.images}
        return len({found.image.name for m in self.models for found in m.images} - sure)

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
