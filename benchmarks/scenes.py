"""Cost and accuracy of a batch's reconstruction, from noisy and wrong matches with known cameras.

python -m benchmarks.scenes [26:304 100:2000] [--world front|street]

Each size is images:pairs and runs in a separate process, as in the engine. With `front`, all images
see one facade; with `street`, images see only nearby facades. `verify` and `map` are CPU seconds.
Errors of the relative rotation and of the direction of translation are in degrees, medians over
pairs.
"""

import argparse
import resource
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np

from benchmarks.synthetic_scene import (
    SyntheticScene,
    registered_images,
    street,
    synthetic_scene,
)
from mkpc_kaggle.geometry.cameras import relative_pose
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene import colmap
from mkpc_kaggle.scene.sfm import Solution, reconstruct_batch


def row(size: str, world: str) -> str:
    """Reconstruct a batch of this size, and return its row of the table."""
    images, pairs = map(int, size.split(":"))
    scene = street(images, pairs)
    if world == "front":
        scene = synthetic_scene(images, pairs, points=2500)
    seconds: defaultdict[str, float] = defaultdict(float)
    # The process is thrown away after this row, so nothing is restored.
    for name in ("verify", "run_mapper"):
        setattr(colmap, name, timed(getattr(colmap, name), name, seconds))
    begin = time.process_time()
    solution = reconstruct_batch(scene.pairs, SceneConfig())
    used = time.process_time() - begin
    # Megabytes: Linux reports kilobytes.
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    matches = np.mean([len(pair.matches) for pair in scene.pairs])
    # All images, in several models if the graph falls apart.
    registered = sum(found.registered for found in solution.reconstructions)
    angles = errors(solution, scene)
    # Without a reconstruction there is no error to report.
    rotation = direction = np.nan
    if angles:
        rotation, direction = np.median(angles, axis=0)
    return (
        f"{images:7}{len(scene.pairs):7}{matches:9.0f}{seconds['verify']:9.1f}{seconds['run_mapper']:9.1f}{used:9.1f}"
        f"{memory:9.0f}{registered:9}{rotation:10.3f}{direction:11.3f}"
    )


def timed(
    function: Callable[..., Any], name: str, seconds: defaultdict[str, float]
) -> Callable[..., Any]:
    """Wrap ``function`` so that its CPU seconds are added to ``seconds[name]``."""

    def call(*arguments: Any) -> Any:
        begin = time.process_time()
        try:
            return function(*arguments)
        finally:
            seconds[name] += time.process_time() - begin

    return call


def errors(solution: Solution, scene: SyntheticScene) -> list[tuple[float, float]]:
    """Return the errors of rotation and direction of translation, in degrees.

    Only pairs with an F from the scene have them.
    """
    angles = []
    registered = registered_images(solution)
    for pair, choice in zip(scene.pairs, solution.choices, strict=True):
        if not choice.from_scene:
            continue
        camera0 = registered[pair.image0.digest].camera
        camera1 = registered[pair.image1.digest].camera
        R, t = relative_pose(camera0, camera1)
        true_R, true_t = relative_pose(*scene.true_cameras(pair))
        cos_rotation = (np.trace(R @ true_R.T) - 1) / 2
        # The scale of a reconstruction is free, so lengths are not compared.
        cos_direction = t @ true_t / np.linalg.norm(t) / np.linalg.norm(true_t)
        cosines = np.clip((cos_rotation, cos_direction), -1, 1)
        rotation, direction = np.degrees(np.arccos(cosines))
        angles.append((float(rotation), float(direction)))
    return angles


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sizes", nargs="*", default=["26:304", "100:800"])
    parser.add_argument("--world", choices=["front", "street"], default="street")
    arguments = parser.parse_args()
    heads = ("matches", "verify", "map", "all s", "MB", "placed")
    columns = "".join(f"{head:>9}" for head in heads)
    print(f"{'images':>7}{'pairs':>7}{columns}  rotation  direction")
    for size in arguments.sizes:
        # A process for each: its peak memory is that of this batch.
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            print(pool.submit(row, size, arguments.world).result(), flush=True)


if __name__ == "__main__":
    main()
