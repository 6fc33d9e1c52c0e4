"""Errors of cameras over the errors that are expected of them.

python -m benchmarks.expected_errors --train-dir DIR OUT...

Each OUT has the name of a scene of the train side and the results of ``reconstruct`` on its images. The
largest model is moved onto the true cameras. Columns: cameras, the median error of the centres in
percent of the model's size, and the median and the largest ratio of errors to sigmas of rotations,
centres and focal lengths.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from mkpc_kaggle.data.competition import read_train_side
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.scene.align import find_similarity, model_size, moved_by


def numbers(cell: str) -> np.ndarray:
    return np.array(cell.split(";"), np.float64)


def ratios(table: pd.DataFrame, true_cameras: dict[str, Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of rotations in degrees, of centres in model sizes and of focal lengths in
    percent, (N, 3), and the same over their sigmas.
    """
    cameras = [
        Camera(
            numbers(str(row.K)).reshape(3, 3),
            numbers(str(row.R)).reshape(3, 3),
            numbers(str(row.t)),
        )
        for row in table.itertuples()
    ]
    targets = [true_cameras[name] for name in table["image"]]
    similarity = find_similarity(cameras, targets)
    assert similarity is not None, "the model has too few true cameras"
    moved = [similarity.of_camera(camera) for camera in cameras]
    cosines = [
        (np.trace(camera.R @ target.R.T) - 1) / 2
        for camera, target in zip(moved, targets, strict=True)
    ]
    rotations = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    centres = moved_by(moved, targets) / model_size(targets)
    focals = [
        100 * abs(camera.K[0, 0] / target.K[0, 0] - 1)
        for camera, target in zip(cameras, targets, strict=True)
    ]
    errors = np.column_stack([rotations, centres, focals])
    sigmas = table[["rotation_sigma", "centre_sigma", "focal_sigma"]].to_numpy(np.float64)
    return errors, errors / sigmas


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("out", type=Path, nargs="+")
    arguments = parser.parse_args()
    print("| scene | cameras | centres, % | rotations | centres | focal lengths |")
    print("|" + " --- |" * 6)
    for out in arguments.out:
        (scene,) = read_train_side(arguments.train_dir, scenes=[out.name], min_covisibility=0)
        cameras: dict[str, Camera] = {}
        for true in scene.pairs:
            cameras |= zip(true.pair.names, (true.camera0, true.camera1), strict=True)
        table = pd.read_csv(out / "cameras.csv")
        table = table[table["model"] == 0]
        errors, over_sigmas = ratios(table, cameras)
        cells = [
            f"{middle:.1f}, {most:.1f}"
            for middle, most in zip(
                np.median(over_sigmas, axis=0), over_sigmas.max(axis=0), strict=True
            )
        ]
        print(
            f"| {out.name} | {len(table)} | {100 * np.median(errors[:, 1]):.2f} | {' | '.join(cells)} |"
        )


if __name__ == "__main__":
    main()
