"""Matchers, scenes and places that go wrong on purpose, importable by worker processes."""

import os
import resource
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from multiprocessing import resource_tracker, util
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from rectified import THREE_UNITS, RectifiedMatcher, Seen

from mkpc_kaggle.engine import places, session
from mkpc_kaggle.engine.places import Kind, LocalSite, Place
from mkpc_kaggle.engine.process import ThreadWorker
from mkpc_kaggle.engine.request import SceneJob
from mkpc_kaggle.engine.worker import MatchRunner, compute_scene
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import Picture
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.models import Reconstruction, RegisteredImage, SfmModel
from mkpc_kaggle.scene.sfm import Solution
from mkpc_kaggle.setup.assembly import Assembly

BROKEN = "CUDA error: an illegal memory access was encountered"
ASSERTED = "CUDA error: device-side assert triggered"


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def hang() -> None:
    """Sleep until killed; a file has the id of the process."""
    (Path(os.environ["MKPC_TEST_HOME"]) / "hangs").write_text(str(os.getpid()))
    time.sleep(1000)


def lack_an_image() -> None:
    raise KeyError("image 7")


def exhaust_memory() -> None:
    """Ask for more than a limit allows, 64 MiB above what there is now."""
    # A fixed limit would depend on what torch maps at its import.
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20), resource.RLIM_INFINITY))
    np.ones(1 << 28)


def exhaust_gpu() -> None:
    raise RuntimeError("CUDA out of memory. Tried to allocate 20.00 GiB")


def break_device() -> NoReturn:
    raise RuntimeError(
        f"{BROKEN}\nCUDA kernel errors might be asynchronously reported at some other API call"
    )


def breaks_after(pairs: int) -> Callable[[int], int]:
    """Answers of a matcher whose device fails after ``pairs`` pairs.

    From then on it fails at everything in this process, as after a real CUDA error.
    """
    calls = count()
    return lambda _: 150 if next(calls) < pairs else break_device()


@dataclass
class FaultyMatcher(RectifiedMatcher):
    """``fault`` befalls the pair of brightness ``at`` on views longer than ``above``; only once, with ``once``,
    a file that marks that it has happened.
    """

    fault: Callable[[], None] = die
    at: int = 13
    above: int = 0
    once: Path | None = None

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        if (
            seen0.brightness == self.at
            and max(seen0.view.content) > self.above
            and self._is_due()
        ):
            self.fault()
        return super()._match(seen0, seen1)

    def _is_due(self) -> bool:
        if self.once is None:
            return True
        is_due = not self.once.exists()
        self.once.touch()
        return is_due


@dataclass
class PoisonedMatcher(RectifiedMatcher):
    """Asserts on the device at the pair of brightness ``at``. After that, each call of this object fails, as
    each call of a process does.

    ``first`` is the text of the first error. Errors of Python need not name the device.
    """

    at: int = 13
    first: str = ASSERTED
    is_poisoned: bool = False

    def encode(self, pictures: Sequence[Picture]) -> list[Seen]:
        self.synchronise()
        return super().encode(pictures)

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        self.synchronise()
        if seen0.brightness == self.at:
            self.is_poisoned = True
            raise RuntimeError(self.first)
        return super()._match(seen0, seen1)

    def synchronise(self) -> None:
        if self.is_poisoned:
            raise RuntimeError(ASSERTED)


@dataclass
class NarrowMatcher(RectifiedMatcher):
    """Has no memory for more than ``most`` pairs at a time; notes how many it was given each time."""

    most: int = 2

    def __post_init__(self) -> None:
        self.sizes: list[int] = []

    def match(self, encodings0: Sequence[Seen], encodings1: Sequence[Seen]) -> list[Matches]:
        self.sizes.append(len(encodings0))
        if len(encodings0) > self.most:
            raise RuntimeError("cuDNN error: CUDNN_STATUS_ALLOC_FAILED")
        return super().match(encodings0, encodings1)


# The scenes of these tests give it to all pairs.
SCENE_F = np.array(
    [
        [0.0, 0, 0.2],
        [0, 0, -0.5],
        [-0.3, 0.6, 0.5],
    ]
)


def runner(run: Callable[[SceneJob], Solution]) -> Callable[[SceneJob], Solution]:
    """Return ``run``: a maker, partial(runner, run), can be pickled."""
    return run


def scenes_by(
    monkeypatch: pytest.MonkeyPatch,
    make: Callable[[SceneJob], Solution],
    *,
    process: bool = False,
) -> None:
    """Let ``make`` reconstruct batches, in a thread of this process or, as real runs do, in a
    process.
    """
    if process:
        monkeypatch.setattr(places, "scene_runner", partial(runner, make))
    else:
        worker = partial(ThreadWorker, "scene", partial(runner, make))
        monkeypatch.setattr(LocalSite, "scene_worker", lambda site: worker(site.ring))


def choose_scene_for_all_but_the_first(job: SceneJob) -> Solution:
    """Answer as a reconstruction would, with one point for each match."""
    by_scene = (Choice(SCENE_F, Reason.SCENE),) * (len(job.pairs) - 1)
    choices = (Choice(None, Reason.CONTRADICTION), *by_scene)
    images = {image.name: image for pair in job.pairs for image in pair.images}
    names = tuple(sorted(images))
    camera = Camera(np.eye(3), np.eye(3), np.zeros(3))
    registered = tuple(RegisteredImage(images[name], camera, 99) for name in names)
    points = np.zeros((job.matches, 3))
    return Solution((Reconstruction(names, (SfmModel(registered, points, 0.5),)),), choices)


def befall(fault: Callable[[], None], job: SceneJob) -> Solution:
    """A fault in the place of a reconstruction."""
    fault()
    raise AssertionError


def die_within_pycolmap(job: SceneJob) -> Solution:
    """Die after its database is written, when cameras are computed."""
    import pycolmap

    # As after an assertion in its C++ code: no exception reaches Python.
    pycolmap.GlobalPipeline = lambda *_: die()
    return compute_scene(job)


def scene_in_a_gigabyte(job: SceneJob) -> Solution:
    """All that it may have; libraries that are only mapped are not counted."""
    resource.setrlimit(resource.RLIMIT_DATA, (1 << 30, 1 << 30))
    return compute_scene(job)


def thread_place(
    name: str,
    matcher: RectifiedMatcher,
    minibatch: int = 1,
    pipeline: Callable[[], Pipeline] | None = None,
) -> Place:
    """Where workers are threads of this process, with that matcher, or that pipeline."""
    make = partial(
        Pipeline, THREE_UNITS, {matcher.name: matcher}.__getitem__, minibatch=minibatch
    )
    # The threads of the tests' process stay as they are.
    runner = partial(MatchRunner, pipeline or make, limit=None)
    worker = partial(ThreadWorker, name, runner, lambda: None)
    return Place(name, worker, minibatch=minibatch)


def use_places(
    monkeypatch: pytest.MonkeyPatch, *used: Place, fallback: Sequence[Place] = ()
) -> None:
    """Let runs match at these places, and look every hundredth of a second for answers, without a
    pause.
    """

    def site_of(
        assembly: Assembly, _: int, clock: Callable[[], float], log: Path
    ) -> LocalSite:
        site = LocalSite(assembly, 0, clock, log)
        site.places = [
            *(place for place in site.places if place.kind is not Kind.MATCH),
            *used,
        ]
        site.fallback = list(fallback)
        return site

    monkeypatch.setattr(session, "LocalSite", site_of)
    monkeypatch.setattr(places, "LISTEN_S", 0.01)


def on_fork(monkeypatch: pytest.MonkeyPatch, act: Callable[[int], None]) -> None:
    """Let something be done with the id of each worker process as soon as it is forked."""
    resource_tracker.ensure_running()  # a process, too
    spawn = util.spawnv_passfds

    def spawned(*arguments: Any) -> int:
        pid: int = spawn(*arguments)
        act(pid)
        return pid

    monkeypatch.setattr(util, "spawnv_passfds", spawned)
