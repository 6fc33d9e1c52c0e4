"""A store, and a run of some pairs whose answers are given by the test."""

import threading
from collections.abc import Iterable

import numpy as np
from rectified import SECOND, SWEEP, THREE_UNITS
from simulator import facts_of

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.keys import Keys
from mkpc_kaggle.engine.places import Site
from mkpc_kaggle.engine.request import (
    About,
    Estimated,
    EstimateJob,
    MatchJob,
    MatchPlan,
    Request,
    SceneJob,
)
from mkpc_kaggle.engine.run import Run
from mkpc_kaggle.engine.state import SWEEP as SWEEPING
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.engine.store import Source, Store
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.crop_need import CropNeed
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.models import Reconstruction, RegisteredImage, SfmModel
from mkpc_kaggle.scene.sfm import Solution
from mkpc_kaggle.scene.view_graph import BatchImage
from mkpc_kaggle.setup.console import Progress

# Of rank 2
F = np.array([[1.0, 2, 3], [4, 5, 6], [7, 8, 9]])
REGIONS = (
    CriticalRegion(Box(1, 2, 30, 40), RegionReason.CROPPED),
    CriticalRegion(Box(0, 0, 5, 6), RegionReason.TOO_SMALL),
)
RECIPE = Recipe((SWEEP, SECOND), scene=SceneConfig(pairs_per_image=0), mkpc=THREE_UNITS.mkpc)
# No identity, so that rows and columns cannot be exchanged unnoticed
ROTATION = np.eye(3)[[1, 0, 2]]
CAMERA = Camera(np.diag([500.0, 500, 1]), ROTATION, np.array([0.0, 0.0, 1.0]))


def pair_of(number: int) -> Pair:
    """A pair of a batch, with its own image and a common one."""
    return Pair(f"p{number}", "one", f"{number}.png", "c.png")


def keys_of(recipe: Recipe, **other: str) -> Keys:
    units = tuple(unit.name for unit in recipe.units)
    return Keys(units, **{"mkpc": "m", "estimate": "e", "scene": "s"} | other)


def state_of(
    recipe: Recipe = RECIPE,
    pairs: Iterable[Pair] = (),
    contents: dict[str, str] | None = None,
    **other: str,
) -> State:
    """The state of a run whose images have these contents, by default their names."""
    pairs = list(pairs) or [pair_of(number) for number in range(3)]
    names = {name for pair in pairs for name in (pair.file0, pair.file1)}
    images = {
        name: BatchImage(name, (contents or {}).get(name, name), Size(80, 60), 99.0)
        for name in names
    }
    about = About({**recipe.table(), "name": "x"})
    return State(Request(pairs, recipe, keys_of(recipe, **other), about=about), images)


class Room:
    """A store, and a run of some pairs, whose answers are given by the test."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.ask()

    def ask(
        self,
        recipe: Recipe = RECIPE,
        pairs: Iterable[Pair] = (),
        contents: dict[str, str] | None = None,
        **other: str,
    ) -> None:
        """Begin a run, as a session does. ``other`` are other settings."""
        self.state = state_of(recipe, pairs, contents, **other)
        facts = [
            (image.name, 0, 0, image.digest, 80, 60, 0.0)
            for image in self.state.images.values()
        ]
        self.store.put({"image": facts})
        self.state.restore(self.store)
        budget = Budget(0.0)
        site = Site(budget.clock)
        progress = Progress(is_shown=False)
        self.run = Run(self.state, site, self.store, budget, threading.Event(), progress)

    def match(self, index: int, *units: Unit, need: CropNeed | None = None) -> None:
        """Save points of a pair."""
        found = []
        for unit in units:
            of_crops = {"need": need, "regions": REGIONS} if unit.stage == 2 else {}
            found.append(UnitResult(unit, matches_of(index), 0.5, 0.25, **of_crops))
        plan = MatchPlan(SWEEPING, [index], [], [], 0.0, [])
        inputs = self.state.inputs_of(index)
        job = MatchJob((inputs,), self.state.request.recipe, Source(), plan)
        self.run.save(job, (PairMatch(tuple(found)),), 0.5)

    def estimate(self, index: int) -> None:
        inputs = self.state.inputs_of(index)
        inliers = {key: 7 + number for number, key in enumerate(inputs.points.values())}
        job = EstimateJob((inputs,), self.state.request.recipe, Source())
        self.run.save(job, (Estimated(facts_of(inliers, F, 2 * F)),), 0.5)

    def reconstruct(self) -> None:
        state = self.state
        pairs, key = state.scene_inputs(0)
        placed = [
            RegisteredImage(BatchImage(name, name, Size(80, 60)), CAMERA, 9)
            for name in ("0.png", "1.png")
        ]
        model = SfmModel(tuple(placed), np.array([[0.0, 0.0, 5.0]]), 0.7)
        choices = [
            Choice(3 * F, Reason.SCENE),
            *[Choice(None, Reason.UNREGISTERED)] * (len(pairs) - 1),
        ]
        answer = Solution((Reconstruction(("0.png", "1.png"), (model,)),), tuple(choices))
        recipe = state.request.recipe
        job = SceneJob(pairs, recipe, Source(), (0, 0), "one", "", key, 60)
        self.run.save(job, answer, 1.5)

    def publish(self) -> None:
        self.run.publication.publish()

    @property
    def standing(self) -> tuple[int, int, bool]:
        """The number of pairs with points of today, of estimates of today, and whether the scene
        is.
        """
        done = int(self.state.used.any(1).sum())
        return done, int(self.state.estimated.sum()), not self.state.stale.any()


def matches_of(index: int) -> Matches:
    rng = np.random.default_rng(index)
    return Matches(rng.random((30, 2)), rng.random((30, 2)), rng.random(30))
