"""Structure from motion by pycolmap: keypoints and their matches in, cameras and points out.

pycolmap can end the process on its own (a failed assertion, memory), the global mapper has no time limit, and once
it is imported a SIGTERM ends the process with a stack trace on stderr: whoever cannot afford that calls this in a
process of its own.

The same input gives the same bytes on one machine with ``threads = 1``. With more threads, sums are added in
another order each time, and the last digits differ.

Sources: Schoenberger and Frahm 2016 (the incremental mapper), Pan et al. 2024 (the global one).
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.scene.config import Mapper, SceneConfig
from mkpc_kaggle.scene.keypoints import SceneKeypoints
from mkpc_kaggle.scene.model import Model, PlacedImage
from mkpc_kaggle.scene.one_camera import OneCameras, camera_of

CENTRE = 0.5
"""In COLMAP the top-left pixel's centre is (0.5, 0.5); here it is (0, 0)."""


def reconstruct(
    names: Sequence[str],
    sizes: Sequence[Size],
    keypoints: SceneKeypoints,
    config: SceneConfig,
    known: OneCameras,
) -> tuple[Model, ...]:
    """The models that pycolmap makes of connected images, as they come, the largest first; perhaps none.

    ``names``, ``sizes`` and ``keypoints.points`` are of the same images. Each image has a camera of its own but
    those of ``known`` cameras, which start at their focal lengths.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(config.seed)
    with tempfile.TemporaryDirectory(prefix="scene-") as folder:
        database = Path(folder) / "database.db"
        _write(database, names, sizes, keypoints, config, known)
        _verify(database, config)
        found = _map(database, Path(folder), len(sizes), config)
        models = [_model(found[number], names, sizes) for number in sorted(found)]
    return tuple(sorted(models, key=lambda model: (-len(model.images), -len(model.points))))


def _write(
    path: Path,
    names: Sequence[str],
    sizes: Sequence[Size],
    keypoints: SceneKeypoints,
    config: SceneConfig,
    known: OneCameras,
) -> None:
    """Images and frames are numbered by the image's place plus one, cameras and rigs by their first image."""
    first: dict[Size, int] = {}
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for number, (name, size, points) in enumerate(zip(names, sizes, keypoints.points, strict=True), start=1):
            camera = camera_of(known, name, size)
            taken_by = first.setdefault(size, number) if camera else number
            if taken_by == number:
                focal = camera.focal if camera else config.prior_focal * max(size)
                _write_camera(database, number, size, focal, config)
            image = pycolmap.Image(
                name=f"{number:06}", camera_id=taken_by, image_id=number, keypoints=np.zeros((0, 2))
            )
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=number, rig_id=taken_by)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(number, points + np.float32(CENTRE))
        for edge in keypoints.edges:
            database.write_matches(edge.first + 1, edge.second + 1, edge.index)


def _write_camera(database: Any, number: int, size: Size, focal: float, config: SceneConfig) -> None:
    """A camera, and a rig of it alone."""
    camera = pycolmap.Camera.create_from_model_name(number, config.camera_model.value, focal, *size)
    camera.has_prior_focal_length = True  # a pair that E explains at the prior is used as calibrated
    database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=number)
    rig.add_ref_sensor(camera.sensor_id)
    database.write_rig(rig, use_rig_id=True)


def _verify(database: Path, config: SceneConfig) -> None:
    """Keep the matches of each pair that agree on an epipolar geometry."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_error = config.verification_error
    options.ransac.random_seed = config.seed
    options.min_num_inliers = config.least_inliers
    options.detect_watermark = (
        False  # it looks for matches that stand still, of which a pair of near views has many
    )
    threads = pycolmap.GeometricVerifierOptions()
    threads.num_threads = config.threads
    pycolmap.geometric_verification(database, threads, pycolmap.ExistingMatchedPairingOptions(), options)


def _map(database: Path, folder: Path, image_count: int, config: SceneConfig) -> dict[int, Any]:
    if image_count > config.most_images:
        hierarchical = pycolmap.HierarchicalPipelineOptions()
        hierarchical.num_threads = config.threads
        hierarchical.num_workers = 1
        hierarchical.clustering_options.leaf_max_num_images = config.most_images
        hierarchical.incremental_options = _incremental(config)
        return dict(pycolmap.hierarchical_mapping(database, folder, folder, hierarchical))
    if config.mapper is Mapper.INCREMENTAL:
        return dict(pycolmap.incremental_mapping(database, folder, folder, _incremental(config)))
    return dict(pycolmap.global_mapping(database, folder, folder, _global(config)))


def _incremental(config: SceneConfig) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = config.least_images
    options.min_num_matches = config.least_inliers
    options.extract_colors = False
    options.num_threads = config.threads
    for part in (options, options.mapper, options.triangulation):
        part.random_seed = config.seed
    return options


def _global(config: SceneConfig) -> Any:
    options = pycolmap.GlobalPipelineOptions()
    options.min_model_size = config.least_images
    options.min_num_matches = config.least_inliers
    mapper = options.mapper
    options.num_threads = mapper.num_threads = config.threads
    for part in (options, mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        part.random_seed = config.seed
    return options


def _model(found: Any, names: Sequence[str], sizes: Sequence[Size]) -> Model:
    images = []
    for number in sorted(found.reg_image_ids()):
        image = found.images[number]
        pose, K = np.asarray(image.cam_from_world().matrix()), np.array(image.camera.calibration_matrix())
        K[:2, 2] -= CENTRE
        camera = Camera(K, pose[:, :3].copy(), pose[:, 3].copy())
        images.append(PlacedImage(names[number - 1], sizes[number - 1], camera, int(image.num_points3D)))
    points = [found.points3D[number].xyz for number in sorted(found.point3D_ids())]
    return Model(
        tuple(images),
        np.array(points, np.float64).reshape(-1, 3),
        float(found.compute_mean_reprojection_error()) if points else 0.0,
    )
