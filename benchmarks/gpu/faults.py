"""A run's workers with a fault: an assembly whose matchers note their calls, and fail on purpose.

Worker processes import this module, so nothing here is of the benchmark's own process.
"""

import json
import os
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, NoReturn

from mkpc_kaggle.matchers.contract import Matcher, Picture, Placement
from mkpc_kaggle.setup.assembly import CUDA_MINIBATCH, Assembly

EVENTS = "events.jsonl"  # a line for each call of a matcher
VICTIM = "victim"  # the file that names the pair of the fault
VICTIM_NUMBER = 2  # its index in the minibatch that comes first
ASSERT = "CUDA error: device-side assert triggered"


class Fault(StrEnum):
    """What goes wrong in the workers of matching."""

    NONE = "none"
    ASSERT = "assert"  # a device-side assert on one pair, on every device and at every try
    MEMORY = "memory"  # PyTorch may use only ``limit`` bytes of the device


@dataclass(frozen=True)
class FaultyAssembly(Assembly):
    """An assembly with a fault. ``home`` is the folder of the events and of the victim.

    ``limit`` is in bytes. A rehearsal on a CPU matches eight pairs at a time, as a GPU does.
    """

    fault: Fault = Fault.NONE
    home: Path = field(default_factory=Path)
    limit: int = 0

    @property
    def minibatch(self) -> int:
        """The number of pairs to match at a time."""
        is_rehearsal = self.device == "cpu"
        return CUDA_MINIBATCH if is_rehearsal else super().minibatch

    def load(self, name: str, placement: Placement | None = None) -> Matcher[Any]:
        """Load a matcher with the fault, in a process with the limit of memory."""
        device = self.placement.device
        if self.fault is Fault.MEMORY and device != "cpu":
            import torch

            _, total = torch.cuda.mem_get_info(device)
            torch.cuda.set_per_process_memory_fraction(self.limit / total, device)
        return FaultyMatcher(super().load(name, placement), self.fault, self.home, device)


@dataclass(frozen=True, eq=False)
class Seen:
    """An encoding with the checksum of its picture."""

    inner: Any
    checksum: int

    @property
    def points(self) -> Any:
        """The keypoints, which the engine counts."""
        return getattr(self.inner, "points", ())


class FaultyMatcher:
    """A matcher that notes its calls in a file, and has the fault."""

    def __init__(self, inner: Matcher[Any], fault: Fault, home: Path, device: str) -> None:
        self.spec = inner.spec
        self._inner = inner
        self._fault = fault
        self._home = home
        self._device = device
        self._is_broken = False  # a failed device fails at everything in its process
        self._note("loaded", 0, _allocated(device))

    def encode(self, pictures: Sequence[Picture]) -> list[Seen]:
        with self._noted("encode", len(pictures)):
            encodings = self._inner.encode(pictures)
        sums = [zlib.crc32(picture.pixels.tobytes()) for picture in pictures]
        return [Seen(*both) for both in zip(encodings, sums, strict=True)]

    def match(self, encodings0: Sequence[Seen], encodings1: Sequence[Seen]) -> Any:
        with self._noted("match", len(encodings0)):
            if self._fault is Fault.ASSERT and self._has_victim(encodings0, encodings1):
                self._is_broken = True
                break_device(self._device)
            return self._inner.match(
                [seen.inner for seen in encodings0], [seen.inner for seen in encodings1]
            )

    @contextmanager
    def _noted(self, call: str, count: int) -> Iterator[None]:
        """Note a call with its peak of memory, or its error."""
        if self._is_broken:
            raise RuntimeError(ASSERT)
        _reset_peak(self._device)
        try:
            yield
        except Exception as error:
            self._note(call, count, 0, error=f"{type(error).__name__}: {error}"[:200])
            raise
        self._note(call, count, _peak(self._device))

    def _note(self, call: str, count: int, memory: int, error: str = "") -> None:
        event = {"pid": os.getpid(), "device": self._device, "call": call, "count": count}
        event |= {"memory": memory, "error": error}
        # One write of one line, so that lines of two processes do not mix.
        with (self._home / EVENTS).open("a") as file:
            file.write(json.dumps(event) + "\n")

    def _has_victim(self, encodings0: Sequence[Seen], encodings1: Sequence[Seen]) -> bool:
        """Return whether one of the pairs is the victim, which the first call of a run chooses."""
        pairs = [
            f"{first.checksum} {second.checksum}"
            for first, second in zip(encodings0, encodings1, strict=True)
        ]
        victim = self._home / VICTIM
        chosen = pairs[min(VICTIM_NUMBER, len(pairs) - 1)]
        # A link appears at once with its content, so that two workers agree.
        own = victim.with_name(f"{VICTIM}.{os.getpid()}")
        own.write_text(chosen)
        with suppress(FileExistsError):
            os.link(own, victim)
        return victim.read_text() in pairs


def break_device(device: str) -> NoReturn:
    """Trigger a device-side assert, after which the process cannot use its device any more."""
    if device != "cpu":
        import torch

        values = torch.zeros(4, device=device)
        # An index out of range: the kernel asserts, and the next synchronisation reports it.
        values[torch.tensor([1_000_000], device=device)].sum().item()
    raise RuntimeError(ASSERT)


def _allocated(device: str) -> int:
    if device == "cpu":
        return 0
    import torch

    return torch.cuda.memory_allocated(device)


def _reset_peak(device: str) -> None:
    if device != "cpu":
        import torch

        torch.cuda.reset_peak_memory_stats(device)


def _peak(device: str) -> int:
    if device == "cpu":
        return 0
    import torch

    return torch.cuda.max_memory_allocated(device)
