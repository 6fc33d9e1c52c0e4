"""Pairs that `reconstruct` leaves out of large folders: shares kept by covisibility.

python -m benchmarks.shortlists --train-dir DIR [--scenes NAME ...] [--mixed NAME ...]

A row for each scene has the share of its pairs that may overlap by their largest keypoints, in
classes of covisibility. `--mixed` puts the images of these scenes into one folder: the output has
the share of pairs of different scenes that may overlap, and the share of each class that the 20
partners by VLAD have. CPU milliseconds are of an image's features and of a pair.
"""

import argparse
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch

from mkpc_kaggle.data.competition import TrainScene, read_train_side
from mkpc_kaggle.scene import likeness
from mkpc_kaggle.scene.likeness import (
    PARTNERS,
    largest_features,
    local_features,
    most_alike,
    overlapping,
    shortlist,
)

BOUNDS = (0.0, 0.02, 0.1, 0.2, 0.3, 0.5, 1.01)  # of classes of covisibility
Pairs = set[tuple[Path, Path]]


def files_of(scenes: Sequence[TrainScene]) -> list[Path]:
    return sorted({file for scene in scenes for true in scene.pairs for file in true.pair.images})


def may_overlap(files: Sequence[Path]) -> tuple[Pairs, float, float]:
    """Return the pairs of images that may overlap, and milliseconds of an image and of a pair."""
    begin = time.process_time()
    features = [largest_features(file) for file in files]
    of_image = (time.process_time() - begin) / len(files)
    begin = time.process_time()
    found = overlapping(features)
    of_pair = (time.process_time() - begin) / (len(files) * (len(files) - 1) / 2)
    return {(files[i], files[j]) for i, j in found}, 1000 * of_image, 1000 * of_pair


def alike(files: Sequence[Path]) -> Pairs:
    """Return the pairs of images and their partners by VLAD."""
    features = [local_features(file) for file in files]
    return {(files[i], files[j]) for i, j in shortlist(most_alike(lambda: features, PARTNERS))}


def cells(scene: TrainScene, kept: Pairs) -> str:
    """Return the share of a scene's pairs that are kept, by class, with the number of pairs."""
    shown = []
    for low, high in pairwise(BOUNDS):
        inside = [true for true in scene.pairs if low <= true.covisibility < high]
        found = [tuple(sorted(true.pair.images)) in kept for true in inside]
        shown.append(f"{np.mean(found):.2f} ({len(found)})" if found else "")
    return " | ".join(shown)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--scenes", nargs="*", default=[])
    parser.add_argument("--mixed", nargs="*", default=[])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    # Here the share decides nothing: all pairs are looked at.
    likeness.ONE_PLACE = 1.01
    heads = " | ".join(f"from {low:g}" for low in BOUNDS[:-1])
    print(f"| | {heads} | image, ms | pair, ms |\n|" + " --- |" * (len(BOUNDS) + 2))
    for name in arguments.scenes:
        (scene,) = read_train_side(arguments.train_dir, scenes=[name], min_covisibility=0)
        kept, of_image, of_pair = may_overlap(files_of([scene]))
        print(f"| {name} | {cells(scene, kept)} | {of_image:.0f} | {of_pair:.1f} |", flush=True)
    if arguments.mixed:
        scenes = read_train_side(arguments.train_dir, scenes=arguments.mixed, min_covisibility=0)
        files = files_of(scenes)
        kept, _, _ = may_overlap(files)
        partners = alike(files)
        for scene in scenes:
            print(f"| {scene.name}, 20 partners | {cells(scene, partners)} | | |")
        every = len(files) * (len(files) - 1) // 2
        across = every - sum(
            len(scene_files) * (len(scene_files) - 1) // 2
            for scene_files in (files_of([scene]) for scene in scenes)
        )
        foreign = sum(first.parent != second.parent for first, second in kept)
        print(
            f"\n{len(files)} images: {foreign / across:.2f} of {across} pairs of different scenes may overlap"
        )
        print(f"{len(kept)} of {every} pairs may overlap, {len(partners)} are partners by VLAD")


if __name__ == "__main__":
    main()
