"""A folder of mixed photographs with the ground truth for the score of 2025.

    python -m benchmarks.mixed_folder --train-dir DIR --unrelated IMAGE... --out DIR

OUT/images/mixed has the images of all scenes, and unrelated images. OUT has ``train_labels.csv``,
and ``train_thresholds.csv`` with thresholds of 0.025 to 1 m.
"""

import argparse
import csv
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mkpc_kaggle.data.competition import read_train_side
from mkpc_kaggle.evaluation.imc2025 import OUTLIERS, POSE_COLUMNS
from mkpc_kaggle.reconstruction.outputs import joined

SCENES = ("castle_p19", "fountain_p11", "herz_jesus_p8", "reichstag_26")
THRESHOLDS = "0.025;0.05;0.1;0.2;0.5;1.0"  # metres; the score skips the two finest


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--unrelated", type=Path, nargs="*", default=[])
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    folder = arguments.out / "images" / "mixed"
    folder.mkdir(parents=True)  # fails for a former output, whose images would stay
    rows = []
    for scene in read_train_side(arguments.train_dir, scenes=SCENES, min_covisibility=0):
        cameras = {}
        for true in scene.pairs:
            file0, file1 = true.pair.images
            cameras[file0] = true.camera0
            cameras[file1] = true.camera1
        for file, camera in sorted(cameras.items()):
            shutil.copy(file, folder)
            # In metres, as the thresholds are.
            translation = joined(camera.t * scene.metres_per_unit)
            rows.append(("mixed", scene.name, file.name, joined(camera.R), translation))
    # Images of no scene have no pose.
    no_rotation = joined(np.full(9, np.nan))
    no_translation = joined(np.full(3, np.nan))
    for path in arguments.unrelated:
        shutil.copy(path, folder)
        rows.append(("mixed", OUTLIERS, path.name, no_rotation, no_translation))
    write(arguments.out / "train_labels.csv", [POSE_COLUMNS, *rows])
    limits = [("mixed", scene, THRESHOLDS) for scene in SCENES]
    write(arguments.out / "train_thresholds.csv", [("dataset", "scene", "thresholds"), *limits])


def write(path: Path, rows: Sequence[Sequence[str]]) -> None:
    """Write a table."""
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows(rows)


if __name__ == "__main__":
    main()
