"""Time, memory and accuracy of a batch's reconstruction, from matches of known cameras with noise and wrong ones.

python -m benchmarks.scenes [26:304 50:700 100:2000] [--mapper global] [--threads 1] [--points 2500]

Each size is images:pairs, and runs in a process of its own, as in the engine. `median px` is the median over pairs
of the distance of true correspondences from the F that the pair got.
"""

import argparse
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from benchmarks.synthetic_scene import SyntheticScene, synthetic_scene
from mkpc_kaggle.scene.config import Mapper, SceneConfig
from mkpc_kaggle.scene.reconstruct import Solution, reconstruct_batch


def row(size: str, points: int, outliers: float, config: SceneConfig) -> str:
    images, pairs = map(int, size.split(":"))
    scene = synthetic_scene(images, pairs, points=points, outliers=outliers)
    begin, used = time.perf_counter(), time.process_time()
    solution = reconstruct_batch(scene.pairs, config)
    wall, used = time.perf_counter() - begin, time.process_time() - used
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    matches = np.mean([len(pair.matches) for pair in scene.pairs])
    placed = sum(found.registered for found in solution.reconstructions)
    distances = distances_of(solution, scene)
    median = f"{np.median(distances):.2f}" if distances else "-"
    return (
        f"{images:7}{len(scene.pairs):7}{matches:9.0f}{wall:9.1f}{used:9.1f}{memory:9.0f}{placed:9}"
        f"{len(distances) / len(scene.pairs):8.2f}{median:>11}"
    )


def distances_of(solution: Solution, scene: SyntheticScene) -> list[float]:
    answers = zip(solution.choices, scene.pairs, strict=True)
    return [scene.median_distance(choice.F, pair) for choice, pair in answers if choice.F is not None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sizes", nargs="*", default=["10:45", "26:304", "50:700", "100:2000"])
    parser.add_argument("--mapper", type=Mapper, choices=list(Mapper), default=SceneConfig().mapper)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--outliers", type=float, default=0.2)
    parser.add_argument(
        "--points",
        type=int,
        default=2500,
        help="of the front; by default an image has as many as RootSIFT matches",
    )
    arguments = parser.parse_args()
    config = SceneConfig(mapper=arguments.mapper, threads=arguments.threads)
    heads = ("wall s", "cpu s", "MB", "placed", "F from")
    print(
        f"{'images':>7}{'pairs':>7}{'matches':>9}" + "".join(f"{h:>9}" for h in heads[:4]) + "  scenes  median px"
    )
    for size in arguments.sizes:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            print(pool.submit(row, size, arguments.points, arguments.outliers, config).result(), flush=True)


if __name__ == "__main__":
    main()
