"""Matchers that go wrong on purpose, importable by worker processes."""

import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from mkpc_kaggle.engine.pools.process import WORKER_ENVIRONMENT
from mkpc_kaggle.engine.pools.scene_process import serve_scene
from rectified import RectifiedMatcher, Seen

from mkpc_kaggle.data.images import Unreadable
from mkpc_kaggle.engine.scenes import SceneJob
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.reconstruction import Reconstruction, RegisteredImage, SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage


def pipeline_once(assembly: Assembly, marker: Path) -> Pipeline:
    """For the first worker; later ones die while they load."""
    if marker.exists():
        die()
    marker.touch()
    return assembly.pipeline()


def pipeline_in_batches(assembly: Assembly, batch: int) -> Pipeline:
    """As on a GPU."""
    return Pipeline(assembly.recipe, assembly.matchers.__getitem__, minibatch=batch)


def pipeline_telling_its_environment(assembly: Assembly, told: Path) -> Pipeline:
    """What a worker's PyTorch is told, as the process was started with it."""
    started_with = dict(
        entry.split("=", 1) for entry in Path("/proc/self/environ").read_text().split("\0") if "=" in entry
    )
    told.write_text(", ".join(started_with.get(name, "") for name in WORKER_ENVIRONMENT))
    return assembly.pipeline()


Fault = Callable[[], None]


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def nothing() -> None:
    """Only the mark is left that it was there."""


def hang() -> None:
    time.sleep(1000)


def exhaust_memory() -> None:
    """Ask for more than a limit allows."""
    limit_memory(64 << 20)
    np.ones(1 << 28)


def limit_memory(bytes_left: int) -> None:
    """Let this process have so much more than it has now."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + bytes_left, resource.RLIM_INFINITY))


def exhaust_gpu() -> None:
    raise RuntimeError("CUDA out of memory. Tried to allocate 20.00 GiB")


@dataclass
class FaultyMatcher(RectifiedMatcher):
    """``fault`` befalls the pair of brightness ``at`` on views longer than ``above``; only once, with ``once``,
    a file that marks that it has happened.
    """

    fault: Fault = die
    at: int = 13
    above: int = 0
    once: Path | None = None

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        if seen0.brightness == self.at and max(seen0.view.content) > self.above and self._due():
            self.fault()
        return super()._match(seen0, seen1)

    def _due(self) -> bool:
        if self.once is None:
            return True
        due = not self.once.exists()
        self.once.touch()
        return due


@dataclass
class BrokenDeviceMatcher(RectifiedMatcher):
    """A device that fails after ``good`` pairs, and from then on at everything in this process, as CUDA does; in
    later ones too if it is broken ``for_good``. ``marker`` is a file that tells them that it has happened.
    """

    marker: Path = Path()
    good: int = 5
    for_good: bool = False
    failed: bool = False

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        happened = self.marker.exists()
        if self.for_good if happened else len(self.calls) >= self.good:
            self.marker.touch()
            self.failed = True
        if self.failed:
            raise RuntimeError(
                "CUDA error: an illegal memory access was encountered\n"
                "CUDA kernel errors might be asynchronously reported at some other API call"
            )
        return super()._match(seen0, seen1)


@dataclass
class NarrowMatcher(RectifiedMatcher):
    """Has no memory for more than ``most`` pairs at a time; writes how many it was given to the file ``sizes``."""

    most: int = 1
    sizes: Path = Path()

    def match(self, encodings0: Sequence[Seen], encodings1: Sequence[Seen]) -> list[Matches]:
        with self.sizes.open("a") as log:
            log.write(f"{len(encodings0)} ")
        if len(encodings0) > self.most:
            raise RuntimeError("cuDNN error: CUDNN_STATUS_ALLOC_FAILED")
        return super().match(encodings0, encodings1)


@dataclass
class RefusingMatcher(RectifiedMatcher):
    """Raises at every pair."""

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        raise ValueError("no such layer")


@dataclass
class SlowingMatcher(RectifiedMatcher):
    """Ten times slower from the call of that number on."""

    turn: int = 0

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        if len(self.calls) == self.turn:
            self.seconds *= 10
        return super()._match(seen0, seen1)


@dataclass
class NonsenseMatcher(RectifiedMatcher):
    """Points that are not finite or not on the image on every second pair, besides good ones on the others."""

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        matches = super()._match(seen0, seen1)
        bad = Matches([[np.nan, 1], [np.inf, 2], [-50, 3], [1e6, 4]], [[1, 1]] * 4, [1, np.nan, 1, 1])
        return Matches.concatenate([bad, matches]) if seen0.brightness % 2 == 0 else bad


@dataclass
class VanishingMatcher(RectifiedMatcher):
    """Takes a file away at its first call."""

    victim: Path = Path()

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        self.victim.unlink(missing_ok=True)
        return super()._match(seen0, seen1)


@dataclass
class FarMatcher(RectifiedMatcher):
    """Where it is sent to, the paths of the machine it comes from lead nowhere."""

    def __setstate__(self, state: dict[str, object]) -> None:
        from mkpc_kaggle.engine.pools import ray_actor

        vars(self).update(state)
        ray_actor.stamp_of = lambda _: None
        ray_actor.read_image = lambda path: Unreadable(str(path), "not on this machine")


SCENE_F = np.array([[0.0, 0, 0.2], [0, 0, -0.5], [-0.3, 0.6, 0.5]])
"""What the scene of these tests says of every pair."""


def choose_scene_for_all_but_the_first(job: SceneJob, answers: Connection) -> None:
    """As a reconstruction would, without one; it makes as many points as there are matches."""
    choices = {index: Choice(SCENE_F, Reason.SCENE) for index in job.indices[1:]}
    choices[job.indices[0]] = Choice(None, Reason.CONTRADICTION)
    names = tuple(sorted({name for pair in job.pairs for name in (pair.image0.name, pair.image1.name)}))
    camera = Camera(np.eye(3), np.eye(3), np.zeros(3))
    images = (BatchImage(name, name, Size(80, 72)) for name in names)
    registered = tuple(RegisteredImage(image, camera, 99) for image in images)
    points = np.zeros((sum(len(pair.matches) for pair in job.pairs), 3))
    answers.send(((Reconstruction(names, (SfmModel(registered, points, 0.5),)),), choices))


def die_as_scene(*_: object) -> None:
    die()


def raise_as_scene(*_: object) -> None:
    raise SystemExit(3)


def hang_as_scene(*_: object) -> None:
    hang()


def hang_as_scene_of_batch_one(job: SceneJob, answers: Connection) -> None:
    if job.batch == "one":
        hang()
    choose_scene_for_all_but_the_first(job, answers)


def exhaust_memory_as_scene(*_: object) -> None:
    sys.stderr = open(os.devnull, "w")  # noqa: PTH123, SIM115  # its traceback is no part of the test's output
    exhaust_memory()


def exhaust_memory_within_pycolmap(job: SceneJob, answers: Connection) -> None:
    """Four megabytes are left when it begins."""
    import mkpc_kaggle.scene.colmap  # noqa: F401  # that is not what fails

    limit_memory(4 << 20)
    os.close(2)
    serve_scene(job, answers)


def scene_in_a_gigabyte(job: SceneJob, answers: Connection) -> None:
    """All that it may have; libraries that are only mapped are not counted."""
    resource.setrlimit(resource.RLIMIT_DATA, (1 << 30, 1 << 30))
    serve_scene(job, answers)


def scene_without_pycolmap(job: SceneJob, answers: Connection) -> None:
    sys.modules["pycolmap"] = None  # type: ignore[assignment]  # an import of it fails now
    serve_scene(job, answers)
