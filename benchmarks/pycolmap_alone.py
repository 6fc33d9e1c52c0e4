"""The alternative: SIFT, exhaustive matching and mappers of pycolmap, on the same pairs.

python -m benchmarks.pycolmap_alone --train-dir DIR [--scenes NAME ...] [--mappers incremental global]
    [--one-camera]

DIR is a train side in the layout of the Image Matching Challenge 2022. All settings are pycolmap's
defaults, except the camera: one SIMPLE_RADIAL per image, or per scene with ``--one-camera``. A pair
fails if no model has both images. The output is the mAA over all pairs with a covisibility of at
least 0.1, and CPU seconds.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap

from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras
from mkpc_kaggle.geometry.coordinates import COLMAP_CENTRE_PX
from mkpc_kaggle.geometry.metrics import PoseError, pair_accuracy, pose_error

Cameras = dict[str, Camera]


def matched(database: Path, images: Path, one_camera: bool) -> None:
    """Write SIFT features of all images, and verified matches of all pairs, to the database."""
    # COLMAP's own default; named, so that the table does not change with its version.
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    pycolmap.extract_features(
        database,
        images,
        camera_mode=pycolmap.CameraMode.SINGLE
        if one_camera
        else pycolmap.CameraMode.PER_IMAGE,
        reader_options=reader,
        device=pycolmap.Device.cpu,
    )
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)


def models(mapper: str, database: Path, images: Path, folder: Path) -> list[Cameras]:
    """Return the cameras of every model by image id, the largest model first."""
    mapping = (
        pycolmap.incremental_mapping if mapper == "incremental" else pycolmap.global_mapping
    )
    found = mapping(database, images, folder)
    cameras = [cameras_of(model) for model in found.values()]
    return sorted(cameras, key=len, reverse=True)


def cameras_of(model: pycolmap.Reconstruction) -> Cameras:
    """Return the cameras of a model by image id; distortion is left out, as F has none."""
    cameras = {}
    for number in model.reg_image_ids():
        image = model.images[number]
        pose = image.cam_from_world().matrix()
        K = model.cameras[image.camera_id].calibration_matrix()
        K[:2, 2] -= COLMAP_CENTRE_PX
        name = Path(image.name).stem
        cameras[name] = Camera(K, pose[:, :3], pose[:, 3])
    return cameras


def error_of(true: TruePair, found: list[Cameras], metres_per_unit: float) -> PoseError:
    """Return the error of a pair's F from the first model that has both images."""
    names = [path.stem for path in true.pair.images]
    # The largest model comes first.
    for cameras in found:
        if all(name in cameras for name in names):
            F = fundamental_of_cameras(*(cameras[name] for name in names))
            return pose_error(F, true.camera0, true.camera1, metres_per_unit)
    return PoseError.failed()


def run(scene: TrainScene, images: Path, mappers: list[str], one_camera: bool) -> None:
    """Print a row for each mapper, on the same features and matches."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        database = folder / "database.db"
        begin = time.process_time()
        matched(database, images, one_camera)
        matching = time.process_time() - begin
        for mapper in mappers:
            begin = time.process_time()
            found = models(mapper, database, images, folder)
            errors = [error_of(true, found, scene.metres_per_unit) for true in scene.pairs]
            # Pairs whose images are in no common model; they count as failed.
            lost = np.mean([not np.isfinite(error.rotation) for error in errors])
            sizes = ", ".join(str(len(cameras)) for cameras in found) or "none"
            maa = np.mean([*map(pair_accuracy, errors)])
            print(
                f"{scene.name:20}{mapper:13}{len(scene.pairs):6}{maa:9.4f}{lost:8.2f}"
                f"{matching:10.0f}{time.process_time() - begin:9.0f}  {sizes}",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--scenes", nargs="*", default=())
    parser.add_argument(
        "--mappers",
        nargs="+",
        default=["incremental", "global"],
        choices=["incremental", "global"],
    )
    parser.add_argument(
        "--one-camera", action="store_true", help="that took all images of a scene"
    )
    arguments = parser.parse_args()
    # Its lines would be between the table's.
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    print(
        f"{'scene':20}{'mapper':13}{'pairs':>6}{'mAA':>9}{'lost':>8}{'match s':>10}{'map s':>9}  images of models"
    )
    for scene in read_train_side(arguments.train_dir, scenes=arguments.scenes):
        images = arguments.train_dir / scene.name / "images"
        run(scene, images, arguments.mappers, arguments.one_camera)


if __name__ == "__main__":
    main()
