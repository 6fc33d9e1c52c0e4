"""A long run of small pairs, killed and resumed in the middle: does any process grow?

    python -m benchmarks.soak [--pairs 20000] [--workers 2 4] [--out DIR]

The matcher is a stand-in that takes no time. Once a fifth of a half is matched, the resident memory
of the parent and of each worker is noted every ten seconds. For each process, the maximum of its last
third must be within 5 % and 50 MB of that of its first half. Linux only.
"""

import argparse
import os
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.engine.store import FILE_NAME
from mkpc_kaggle.geometry.coordinates import Size, View
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, Picture
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.setup.assembly import assemble
from mkpc_kaggle.signals import interruptible

PAGE = os.sysconf("SC_PAGE_SIZE")
MAX_GROWTH, MAX_GROWTH_BYTES = 0.05, 50e6
# With fewer samples, a process has no thirds that could be compared.
MIN_SAMPLES = 6
PAIRS_PER_IMAGE = 3
BATCH_IMAGES = 50
# Decoded, 2.8 MB: a worker's cache is full after 200 images.
SIZE = Size(960, 720)
INTERVAL_S = 10.0
MATCHES = 12


class StandIn:
    """A matcher without work: points of a rectified pair, others for each picture."""

    spec = MatcherSpec("stand-in", version="1")

    def encode(self, pictures: Sequence[Picture]) -> list[tuple[View, int]]:
        return [(picture.view, int(picture.pixels[0, 0, 0])) for picture in pictures]

    def match(
        self, encodings0: Sequence[tuple[View, int]], encodings1: Sequence[tuple[View, int]]
    ) -> list[Matches]:
        return [
            self._match(view0, view1, seed)
            for (view0, seed), (view1, _) in zip(encodings0, encodings1, strict=True)
        ]

    def _match(self, view0: View, view1: View, seed: int) -> Matches:
        rng = np.random.default_rng(seed)
        width, height = view0.content
        points0 = rng.uniform(2, min(width, height) - 20, (MATCHES, 2))
        points1 = points0 + np.column_stack([rng.uniform(0, 15, MATCHES), np.zeros(MATCHES)])
        scores = np.ones(MATCHES, np.float32)
        return Matches(points0.astype(np.float32), points1.astype(np.float32), scores)


@dataclass
class Process:
    """The resident memory of a process in bytes, by time."""

    name: str
    samples: list[int] = field(default_factory=list)

    @property
    def is_long(self) -> bool:
        return len(self.samples) >= MIN_SAMPLES

    @property
    def first(self) -> int:
        # Half: on a busy machine, the imports of a short run take a third of it.
        return max(self.samples[: len(self.samples) // 2])

    @property
    def last(self) -> int:
        return max(self.samples[-(len(self.samples) // 3) :])

    @property
    def grows(self) -> bool:
        return self.last > (1 + MAX_GROWTH) * self.first + MAX_GROWTH_BYTES


@dataclass
class Soaked:
    """The processes of a run, its seconds, and what the parent takes for each pair, in bytes."""

    processes: list[Process]
    seconds: float
    pair_bytes: float
    pairs: int  # with points at the end


def write_pairs(directory: Path, count: int, size: Size) -> None:
    """Write flat images: each with the two that follow it, and with the fifth, in its batch."""
    directory.mkdir(parents=True)
    for number in range(max(BATCH_IMAGES, -(-count // PAIRS_PER_IMAGE))):
        # Each content once, as digests are stored by content.
        pixels = np.full((size.height, size.width, 3), number % 256, np.uint8)
        pixels[-1, -1] = (number >> 16, (number >> 8) % 256, number % 256)
        cv2.imwrite(str(directory / f"{number:06d}.png"), pixels)


def pairs_of(directory: Path, count: int) -> list[Pair]:
    files = sorted(directory.iterdir())
    pairs = []
    for number, file in enumerate(files):
        start = number - number % BATCH_IMAGES
        batch = files[start : start + BATCH_IMAGES]
        for step in (1, 2, 5):
            other = batch[(number - start + step) % len(batch)]
            pairs.append(Pair(f"{number};{step}", f"{start:06d}", str(file), str(other)))
    return pairs[:count]


def run(images: Path, count: int, workers: int, work_dir: Path) -> None:
    """Run the engine in this process until it ends or gets SIGTERM, and print its memory."""
    recipe = Recipe((Unit(1, "stand-in", 96),))
    assembly = assemble(recipe, matchers={"stand-in": StandIn()}, device="cpu")
    before = memory_of(os.getpid())
    with interruptible() as interrupt:
        session = Session(
            work_dir, Budget(time.monotonic()), interrupt, progress=False, workers=workers
        )
        run_pairs(pairs_of(images, count), assembly, session)
    print(memory_of(os.getpid()) - before)


def soak(
    directory: Path,
    pairs: int,
    workers: int,
    *,
    interval: float = INTERVAL_S,
    size: Size = SIZE,
) -> Soaked:
    """Run the pairs, end the run in the middle, resume it, and note the memory of its processes."""
    images = directory / "images"
    if not images.exists():
        write_pairs(images, pairs, size)
    work_dir = directory / f"work-{workers}"
    command = [sys.executable, "-m", "benchmarks.soak", "--run", str(images), str(work_dir)]
    command += ["--pairs", str(pairs), "--workers", str(workers)]
    start = time.monotonic()
    processes: list[Process] = []
    growth = 0
    for part, until in (("first half", pairs // 2), ("resumed", pairs)):
        found: dict[int, Process] = {}
        is_ended = False
        # A fifth of the part is for imports, and for caches that fill.
        begin = matched(work_dir) + pairs // 10
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
            while running.poll() is None:
                count = matched(work_dir)
                if count >= begin:
                    note(running.pid, part, found)
                if until < pairs and not is_ended and count >= until:
                    running.send_signal(signal.SIGTERM)
                    is_ended = True
                with suppress(subprocess.TimeoutExpired):
                    running.wait(interval)
            assert running.stdout is not None
            output = running.stdout.read().split()
        if running.returncode or not output:
            raise SystemExit(f"the run ended with {running.returncode}")
        growth = int(output[-1])
        processes += found.values()
    seconds = time.monotonic() - start
    return Soaked(processes, seconds, growth / pairs, matched(work_dir))


def note(pid: int, part: str, found: dict[int, Process]) -> None:
    """Note the memory of a run's processes."""
    for number, each in enumerate(tree_of(pid)):
        name = "parent" if each == pid else f"process {number}"
        process = found.setdefault(each, Process(f"{name}, {part}"))
        # A process that is ending has no memory.
        if memory := memory_of(each):
            process.samples.append(memory)


def tree_of(pid: int) -> Iterator[int]:
    """Yield a process and those that it started."""
    yield pid
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield from tree_of(int(child))


def memory_of(pid: int) -> int:
    """Return the resident memory of a process in bytes; 0 if it has ended."""
    with suppress(OSError, IndexError):
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE
    return 0


def matched(work_dir: Path) -> int:
    """Return the number of pairs with points in a journal."""
    with suppress(sqlite3.Error):
        uri = f"{(work_dir / FILE_NAME).resolve().as_uri()}?mode=ro"
        with closing(sqlite3.connect(uri, uri=True)) as store:
            (count,) = store.execute("SELECT count(*) FROM points").fetchone()
            return int(count)
    return 0


def table(soaked: Soaked) -> Iterator[str]:
    yield "| process | samples | first half, MB | last third, MB |"
    yield "| --- | --- | --- | --- |"
    for process in soaked.processes:
        if process.is_long:
            first, last = process.first / 1e6, process.last / 1e6
            verdict = " (grows)" if process.grows else ""
            yield f"| {process.name} | {len(process.samples)} | {first:.0f} | {last:.0f}{verdict} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=20_000)
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--out", type=Path, help="default: a temporary directory")
    parser.add_argument("--run", type=Path, nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run is not None:
        run(arguments.run[0], arguments.pairs, arguments.workers[0], arguments.run[1])
        return
    grows = False
    with tempfile.TemporaryDirectory() as temporary:
        for workers in arguments.workers:
            soaked = soak(arguments.out or Path(temporary), arguments.pairs, workers)
            print(f"\n{soaked.pairs} pairs, {workers} workers: {soaked.seconds:.0f} s")
            print(f"the parent's memory: {soaked.pair_bytes:.0f} bytes a pair\n")
            print("\n".join(table(soaked)), flush=True)
            grows |= any(process.grows for process in soaked.processes if process.is_long)
    sys.exit(grows)


if __name__ == "__main__":
    # Workers import the matcher's class by its module's name.
    from benchmarks.soak import main as imported_main

    imported_main()
