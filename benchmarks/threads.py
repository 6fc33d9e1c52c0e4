"""What OpenMP's threads cost each other: SuperGlue alone, and beside processes that compute all the time.

python -m benchmarks.threads [--cores 4] [--rounds 5] [--keypoints 1024]

Each round measures every setting once: threads that spin while they wait (OpenMP's default) or sleep, as in the
engine's workers, and fewer threads. The processes of one setting match at the same time, and their joint matches a
second are printed. Medians of the rounds. Its cores are all that this process may run on, or the first of them.
"""

import argparse
import multiprocessing
import os
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

from mkpc_kaggle.engine.process import worker_environment
from mkpc_kaggle.geometry.coordinates import Size

CONTEXT = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class Setting:
    """``processes`` of ``threads`` each; ``spin``: whether threads do so while they wait."""

    processes: int
    threads: int
    spin: bool

    def __str__(self) -> str:
        if self.threads == 1:
            return f"{self.processes} x 1 thread"
        return f"{self.processes} x {self.threads} threads, {'spin' if self.spin else 'sleep'}"


@dataclass
class WorkerGroup:
    """The processes of one setting, and the seconds of its rounds, by the number of busy processes beside it."""

    setting: Setting
    workers: list[tuple[BaseProcess, Connection]] = field(default_factory=list)
    seconds: dict[int, list[float]] = field(default_factory=dict)

    def start(self, keypoints: int) -> None:
        for _ in range(self.setting.processes):
            parent, child = CONTEXT.Pipe()
            process = CONTEXT.Process(target=match, args=(self.setting.threads, keypoints, child), daemon=True)
            with started_with(self.setting.spin):
                process.start()
            self.workers.append((process, parent))
        for _, worker in self.workers:
            worker.recv()

    def run_round(self, busy: int) -> None:
        """All match at once; the slowest counts."""
        start = time.perf_counter()
        for _, worker in self.workers:
            worker.send(None)
        for _, worker in self.workers:
            worker.recv()
        self.seconds.setdefault(busy, []).append(time.perf_counter() - start)

    def rate(self, busy: int) -> float:
        """Matches a second of all processes together."""
        return self.setting.processes / statistics.median(self.seconds[busy])

    def end(self) -> None:
        for process, _ in self.workers:
            process.kill()
            process.join()


@contextmanager
def started_with(spin: bool) -> Iterator[None]:
    if spin:
        yield
        return
    with worker_environment():
        yield


def match(threads: int, keypoints: int, connection: Connection) -> None:
    """The worker's loop: one match for each message."""
    import torch

    from mkpc_kaggle.matchers.contract import Placement
    from mkpc_kaggle.matchers.networks.placement import prepared
    from mkpc_kaggle.matchers.networks.superglue import SuperGlue
    from mkpc_kaggle.matchers.networks.superpoint import SuperPointKeypoints
    from tests.support.standin import filled

    torch.set_num_threads(threads)
    size = Size(640, 480)
    with torch.inference_mode():
        network = prepared(filled(SuperGlue(20), "superglue"), Placement())
        descriptors = torch.nn.functional.normalize(torch.randn(keypoints, 256), dim=1)
        points, scores = torch.rand(keypoints, 2) * torch.tensor(size), torch.rand(keypoints)
        image = SuperPointKeypoints(points, scores, descriptors, size)
        network(image, image)
        connection.send(None)
        while True:
            connection.recv()
            network(image, image)
            connection.send(None)


def compute(_: int) -> None:
    while True:
        pass


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    processes = [CONTEXT.Process(target=compute, args=(number,), daemon=True) for number in range(count)]
    for process in processes:
        process.start()
    time.sleep(1.0 if count else 0.0)  # until they have started
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


def settings_of(cores: int) -> list[Setting]:
    """One process with all cores, with one less and with one thread; two and one a core that share them."""
    shapes = [(1, cores), (1, max(1, cores - 1)), (2, max(1, cores // 2)), (1, 1), (cores, 1)]
    return [
        Setting(*shape, spin) for shape in dict.fromkeys(shapes) for spin in (True, False) if shape[1] > 1 or spin
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cores", type=int, default=len(os.sched_getaffinity(0)), help="default: all")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--keypoints", type=int, default=1024)
    arguments = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.cores])
    loads = (0, 1)
    groups = [WorkerGroup(setting) for setting in settings_of(arguments.cores)]
    try:
        for group in groups:
            group.start(arguments.keypoints)
        for _ in range(arguments.rounds):
            for busy in loads:
                with busy_processes(busy):
                    for group in groups:
                        group.run_round(busy)
    finally:
        for group in groups:
            group.end()
    print(
        f"{arguments.cores} cores, SuperGlue on {arguments.keypoints} keypoints: seconds a round, pairs a second"
    )
    print(f"{'processes x threads':<24}{'alone':>8}{'':>8}{'beside a busy process':>24}")
    for group in groups:
        columns = [(statistics.median(group.seconds[busy]), group.rate(busy)) for busy in loads]
        print(f"{group.setting!s:<24}" + "".join(f"{seconds:>9.2f}{rate:>8.2f}" for seconds, rate in columns))


if __name__ == "__main__":
    main()
