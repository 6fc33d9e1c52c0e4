"""A store, and a run of some pairs whose answers are given by the test."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rectified import SECOND, SWEEP, THREE_UNITS

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.console import Progress
from mkpc_kaggle.engine.estimates import Estimating
from mkpc_kaggle.engine.jobs import Estimated, MatchJob, Outcome, Phase
from mkpc_kaggle.engine.matching import Matching
from mkpc_kaggle.engine.plan.budget import Budget, Costs
from mkpc_kaggle.engine.plan.state import State
from mkpc_kaggle.engine.publication import Publication
from mkpc_kaggle.engine.request import Request
from mkpc_kaggle.engine.restore import restore
from mkpc_kaggle.engine.run import EventLog, Run
from mkpc_kaggle.engine.scenes import SceneWork
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.image_files import stored_digests
from mkpc_kaggle.engine.store.keys import Keys
from mkpc_kaggle.engine.store.tables import About, ImageFile, UnitPoints
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.models import Reconstruction, RegisteredImage, SfmModel
from mkpc_kaggle.scene.sfm import Solution
from mkpc_kaggle.scene.view_graph import BatchImage

F = np.arange(1.0, 10.0).reshape(3, 3)


REGIONS = (
    CriticalRegion(Box(1, 2, 30, 40), RegionReason.CROPPED, 3, 2),
    CriticalRegion(Box(0, 0, 5, 6), RegionReason.TOO_SMALL),
)


RECIPE = replace(THREE_UNITS, units=(SWEEP, SECOND), scene=SceneConfig(pairs_per_image=0))


# No identity, so that rows and columns cannot be exchanged unnoticed
ROTATION = np.eye(3)[[1, 0, 2]]


CAMERA = Camera(np.diag([500.0, 500, 1]), ROTATION, np.array([0.0, 0.0, 1.0]))


def pair_of(number: int) -> Pair:
    """A pair of a batch, with its own image and a common one."""
    return Pair(f"p{number}", "one", f"{number}.png", "c.png")


def keys_of(recipe: Recipe, **other: str) -> Keys:
    units = tuple(unit.name for unit in recipe.units)
    return Keys(units, **{"mkpc": "m", "estimate": "e", "scene": "s"} | other)


class Room:
    """A store, and the state of a run of some pairs, whose answers are given by the test."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.ask()

    def ask(
        self,
        recipe: Recipe = RECIPE,
        count: int = 3,
        pairs: list[Pair] | None = None,
        extra: Sequence[Pair] = (),
        **other: str,
    ) -> None:
        """Begin a run, as the loop does. ``other`` are other settings."""
        pairs = pairs or [pair_of(number) for number in range(count)]
        request = Request(pairs, recipe, keys_of(recipe, **other), about=About({"name": "x"}))
        self.state = State(request, extra)
        names = [name for names in self.state.names for name in names]
        restore(self.state, self.store, stored_digests(self.store, names))
        budget = Budget(0.0)
        log = EventLog(self.store.directory, budget)
        self.run = Run(
            self.state, self.store, Costs(), budget, log, Progress(budget, is_shown=False)
        )
        self.publication = Publication(self.state, self.store, budget, log)

    def match(self, index: int, *units: Unit, digest: str = "") -> None:
        """Save points of a pair whose first image has this content, by default its own."""
        matches = matches_of(index)
        name0, name1 = self.state.names[index]
        images = (
            BatchImage(name0, digest or name0, Size(80, 60)),
            BatchImage(name1, "common", Size(80, 60), 99.0),
        )
        found = tuple(UnitResult(unit, matches, 0.5, 0.25) for unit in units)
        outcome = Outcome(images, ((1, 1), (2, 2)), found, REGIONS, "", 0.1, 0.2)
        crops = (tuple(self.state.first_stage(index)),)
        job = MatchJob(Phase.SWEEP, (index,), units, (0.0,) * len(units), 0.0, crops=crops)
        Matching(self.run).save(job, [outcome], 0.5)

    def estimate(self, index: int) -> None:
        keys = tuple(self.state.inputs_of(index).points.values())
        each = Estimated(keys, tuple(range(7, 7 + len(keys))), F, magsac=2 * F)
        estimating = Estimating(self.run)
        estimating.save(estimating.job([index]), [each], 0.5)

    def reconstruct(self) -> None:
        state = self.state
        indices, _ = state.scene_inputs("one")
        names = ("0.png", "1.png")
        placed = [RegisteredImage(BatchImage(name, "d", Size(80, 60)), CAMERA, 9) for name in names]
        model = SfmModel(tuple(placed), np.array([[0.0, 0.0, 5.0]]), 0.7)
        choices = [
            Choice(3 * F, Reason.SCENE),
            *[Choice(None, Reason.UNREGISTERED)] * (len(indices) - 1),
        ]
        answer = Solution((Reconstruction(names, (model,)),), tuple(choices))
        reconstructing = SceneWork(self.run)
        reconstructing.save(reconstructing.job("one"), answer, 1.5)

    def publish(self) -> None:
        self.publication.publish()

    def replace(self, name: str) -> None:
        """Give an image another content, as the next start of a run notices."""
        self.store.put([ImageFile(name, "new", 3, 3)])
        self.ask()

    @property
    def standing(self) -> tuple[int, int, bool]:
        """The number of pairs with points of today, of estimates of today, and whether the scene
        is.
        """
        return (
            int(self.state.current.any(1).sum()),
            int(self.state.estimated.sum()),
            not self.state.scenes.stale,
        )


def matches_of(index: int) -> Matches:
    rng = np.random.default_rng(index)
    return Matches(rng.random((30, 2)), rng.random((30, 2)), rng.random(30))


def matches_in(store: Store, keys: Sequence[str]) -> dict[str, int]:
    """The number of matches of points, by key."""
    return {key: points.matches for key, points in store.get(UnitPoints, keys).items()}
