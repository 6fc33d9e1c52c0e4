"""Matchers that go wrong on purpose, importable by worker processes."""

import os
import resource
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rectified import RectifiedMatcher, Seen

from mkpc_kaggle.data.images import Unreadable
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.pipeline.stages import Pipeline


def pipeline_once(assembly: Assembly, marker: Path) -> Pipeline:
    """For the first worker; later ones die while they load."""
    if marker.exists():
        die()
    marker.touch()
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
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20), resource.RLIM_INFINITY))
    np.ones(1 << 28)


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
        from mkpc_kaggle.engine.pools import ray_pool

        vars(self).update(state)
        ray_pool.stamp_of = lambda _: None
        ray_pool.read_image = lambda path: Unreadable(str(path), "not on this machine")
