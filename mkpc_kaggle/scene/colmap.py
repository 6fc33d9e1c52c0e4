"""Structure from motion by pycolmap: from a view graph to cameras and points.

pycolmap can abort the process (failed assertion, out of memory), and the global mapper has no time
limit. Once pycolmap is imported, a SIGTERM ends the process with a stack trace on stderr. To
survive this, run pycolmap in a separate process. Only :func:`write_files` writes to disk.

Source: Pan et al. 2024 (the global mapper).
"""

import shutil
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mkpc_kaggle.cores import available_cores
from mkpc_kaggle.data.outputs import sync
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import COLMAP_CENTRE_PX
from mkpc_kaggle.geometry.focal_prior import FOCAL_RATIO
from mkpc_kaggle.recipe import CameraModel, SceneConfig
from mkpc_kaggle.scene.adjustment import adjust, drop_flat_lenses
from mkpc_kaggle.scene.keypoints import Lens, MergedGraph
from mkpc_kaggle.scene.models import (
    DATABASE,
    MIN_IMAGES,
    MODELS,
    Reconstruction,
    RegisteredImage,
    SfmModel,
    filter_models,
    lens_of,
)
from mkpc_kaggle.scene.view_graph import (
    MIN_MATCHES,
    BatchImage,
    SharedIntrinsics,
    ViewGraph,
    known_by_name,
    supported,
)

# Of a verified match; 1 px loses accuracy on tourist photographs, 4 px on repeated windows
MAX_ERROR_PX = 2.0
# RANSAC trials per edge; more trials find the same inliers at five times the cost
MAX_TRIALS = 300
# The longest ones, from which the global mapper starts in a large scene
TRACKS_PER_IMAGE = 200
# Of the models with shared intrinsics, as in COLMAP's global mapper
MAX_REFINEMENTS = 5
ADJUSTMENT_ITERATIONS = 50  # of each bundle adjustment of a refinement
MIN_CHANGE = 0.0005  # share of the observations; with fewer changes, a model has converged
SEED = 0
# Verification keeps the matches of E or F, whichever explains more, and F knows no focal length. So
# focal lengths of a half to twice the true ones keep 0.998 of the matches of castle_p19 and 0.999 of
# herz_jesus_p8. Beyond, nothing was measured.
MAX_FOCAL_CHANGE = 2.0
# Configurations of a two-view geometry whose H was estimated
WITH_HOMOGRAPHY = (
    pycolmap.TwoViewGeometryConfiguration.PLANAR,
    pycolmap.TwoViewGeometryConfiguration.PANORAMIC,
    pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC,
)


def structure_from_motion(
    merged: MergedGraph,
    shared: SharedIntrinsics,
    config: SceneConfig,
    former: Sequence[SfmModel] = (),
) -> Reconstruction:
    """Return pycolmap's reconstruction of a view graph, with any number of models.

    Each image has its own camera, except images with ``shared`` intrinsics. The initial focal
    length is the shared one, the user's or EXIF's. All focal lengths are refined, unless the user
    knows them. With ``former`` models of the same graph, their poses are refined instead of
    computed again.
    """
    # Its warnings about single images would fill the log.
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(SEED)
    with pycolmap.Database.open(":memory:") as database:
        # The refinement reads the verified matches alone; the mapper reads relative poses, too.
        _fill(database, merged, shared, config, reuse=bool(former))
        if former:
            models = refine_models(database, merged.graph, config.threads, former)
        else:
            models = run_mapper(database, merged.graph, config)
    return _reconstruction(models, merged.graph, config)


def write_files(
    directory: Path,
    merged: MergedGraph,
    shared: SharedIntrinsics,
    models: Sequence[SfmModel],
    config: SceneConfig,
) -> None:
    """Write COLMAP's files: the database and one folder per model, in place of ``directory``.

    A model's files contain only its plausible images. Raises ``OSError`` if writing fails.
    """
    made = directory.with_name(f"{directory.name}.new")
    shutil.rmtree(made, ignore_errors=True)  # of a process that was killed
    (made / MODELS).mkdir(parents=True)
    try:
        file = pycolmap.Database.open(str(made / DATABASE))
    except RuntimeError as error:  # a full disk; its message names no file
        raise OSError(f"{directory / DATABASE} cannot be written") from error
    with file as database:
        _fill(database, merged, shared, config, reuse=True)
        # A lens that became a pinhole: COLMAP refuses a model whose cameras are of another kind.
        for model in models:
            for camera in model.colmap.cameras.values():
                if database.read_camera(camera.camera_id).model != camera.model:
                    database.update_camera(camera)
    for number, model in enumerate(models):
        kept = {each.image.name for each in model.images}
        # A list, because the loop removes frames from the mapping.
        for frame in [frame for frame in model.colmap.frames.values() if frame.has_pose()]:
            if model.colmap.images[frame.frame_id].name not in kept:
                model.colmap.deregister_frame(frame.frame_id)
        folder = made / MODELS / str(number)
        folder.mkdir()
        model.colmap.write(folder)
    sync(made)
    shutil.rmtree(directory, ignore_errors=True)
    made.rename(directory)


def _fill(
    database: Any,
    merged: MergedGraph,
    shared: SharedIntrinsics,
    config: SceneConfig,
    *,
    reuse: bool,
) -> None:
    """Write the images, cameras and keypoints, and each edge's matches and verified geometry.

    An edge without enough support keeps its matches, and has no geometry. For ``reuse`` see
    :func:`verify`.
    """
    # One transaction: a commit for each edge would wait for the disk.
    with pycolmap.DatabaseTransaction(database):
        cameras = _write_images(database, merged, shared, config.camera_model)
        edges = merged.graph.edges
        geometries = verify(merged, cameras, reuse=reuse)
        inliers = [len(geometry.inlier_matches) for geometry in geometries]
        ends = [(edge.first, edge.second) for edge in edges]
        for number, is_supported in enumerate(supported(ends, inliers, config.min_support)):
            if not is_supported:
                geometries[number] = pycolmap.TwoViewGeometry()
        for edge, matches, geometry in zip(edges, merged.matches, geometries, strict=True):
            database.write_matches(edge.first + 1, edge.second + 1, matches)
            database.write_two_view_geometry(edge.first + 1, edge.second + 1, geometry)


def _write_images(
    database: Any, merged: MergedGraph, shared: SharedIntrinsics, camera_model: CameraModel
) -> list[Any]:
    """Write images, frames, cameras and rigs. Return each image's camera.

    Images and frames have the image's index plus one as id. Cameras and rigs have the id of their
    first image.
    """
    graph = merged.graph
    cameras: dict[object, Any] = {}
    used = []
    images = zip(graph.images, merged.keypoints, strict=True)
    for number, (image, points) in enumerate(images, start=1):
        # A known camera is the image's own, perhaps of another camera model.
        focal = None if image.digest in graph.known else shared.get(image.digest)
        # Images of two sizes never share, even at one focal length.
        key = number if focal is None else (image.size, focal)
        if key not in cameras:
            start = _start_camera(graph, image, camera_model, focal)
            cameras[key] = _write_camera(database, number, start)
        camera = cameras[key]
        # The keypoints are in the table of keypoints.
        taken = pycolmap.Image(
            name=image.name,
            camera_id=camera.camera_id,
            image_id=number,
            keypoints=np.zeros((0, 2)),
        )
        database.write_image(taken, use_image_id=True)
        frame = pycolmap.Frame(frame_id=number, rig_id=camera.camera_id)
        frame.add_data_id(taken.data_id)
        database.write_frame(frame, use_frame_id=True)
        database.write_keypoints(number, points + np.float32(COLMAP_CENTRE_PX))
        used.append(camera)
    return used


def _start_camera(
    graph: ViewGraph, image: BatchImage, camera_model: CameraModel, shared: float | None
) -> Any:
    """Return pycolmap's camera that an image starts with: the user's, or one of ``camera_model`` with the
    ``shared`` focal length, EXIF's or a usual one.
    """
    known = graph.known.get(image.digest)
    focal = shared or image.focal or FOCAL_RATIO * max(image.size)
    plain = CameraModel.SIMPLE_PINHOLE if camera_model is CameraModel.AUTO else camera_model
    name = plain.value if known is None else known.model
    camera = pycolmap.Camera.create_from_model_name(0, name, focal, *image.size)
    if known is not None:
        camera.params = list(known.parameters)
    # A pair that E explains at this focal length counts as calibrated
    camera.has_prior_focal_length = True
    return camera


def _write_camera(database: Any, number: int, camera: Any) -> Any:
    """Write a camera, and a rig with only this camera."""
    camera.camera_id = number
    database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=number)
    rig.add_ref_sensor(camera.sensor_id)
    database.write_rig(rig, use_rig_id=True)
    return camera


def verify(merged: MergedGraph, cameras: Sequence[Any], *, reuse: bool = False) -> list[Any]:
    """Return the two-view geometry of each edge, with its inliers, for the ``cameras`` of the
    images.

    Geometries that are known for the same two cameras are not estimated again. With ``reuse``, one
    at other focal lengths is used, too, without its E.
    """
    ransac = {"max_error": MAX_ERROR_PX, "max_num_trials": MAX_TRIALS, "random_seed": SEED}
    # COLMAP takes matches without motion for a watermark, but nearby views have many of these.
    settings = {"ransac": ransac, "min_num_inliers": MIN_MATCHES, "detect_watermark": False}
    options = pycolmap.TwoViewGeometryOptions(settings)
    points = [
        keypoints.astype(np.float64) + COLMAP_CENTRE_PX for keypoints in merged.keypoints
    ]
    lenses = [_lens(camera) for camera in cameras]

    def estimate(number: int) -> None:
        edge = merged.graph.edges[number]
        both = (lenses[edge.first], lenses[edge.second])
        of_edge = merged.geometries.setdefault(number, {})
        similar = [former for former in of_edge if reuse and _are_similar(former, both)]
        if both not in of_edge and similar:
            geometries[number] = _uncalibrated(of_edge[similar[0]])
            return
        if both not in of_edge:
            found: Any = pycolmap.estimate_two_view_geometry(
                cameras[edge.first],
                points[edge.first],
                cameras[edge.second],
                points[edge.second],
                merged.matches[number],
                options,
            )
            # A homography that was not found is memory that pycolmap never wrote.
            if found.config not in WITH_HOMOGRAPHY:
                found.H = None
            of_edge[both] = found
        geometries[number] = of_edge[both]

    geometries: list[Any] = [None] * len(merged.graph.edges)
    # On all cores: an edge starts from the same seed in every thread, so results are the same.
    with ThreadPoolExecutor(available_cores()) as pool:
        list(pool.map(estimate, range(len(geometries))))
    return geometries


def _lens(camera: Any) -> Lens:
    focal = set(camera.focal_length_idxs())
    others = (value for index, value in enumerate(camera.params) if index not in focal)
    return Lens(camera.model, tuple(others), camera.mean_focal_length())


def _are_similar(first: Sequence[Lens], second: Sequence[Lens]) -> bool:
    """Return whether two pairs of cameras verify the same matches."""
    return all(
        (one.model, one.others) == (other.model, other.others)
        and 1 / MAX_FOCAL_CHANGE <= one.focal / other.focal <= MAX_FOCAL_CHANGE
        for one, other in zip(first, second, strict=True)
    )


def _uncalibrated(geometry: Any) -> Any:
    """Return a geometry without E, which holds at its focal lengths alone."""
    kept = pycolmap.TwoViewGeometry(geometry.todict())
    kept.E = None
    if kept.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED:
        kept.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
    return kept


def run_mapper(database: Any, graph: ViewGraph, config: SceneConfig) -> list[Any]:
    """Run the global mapper on a filled database. Return pycolmap's models."""
    common = {"random_seed": SEED, "num_threads": config.threads}
    # Smaller models are dropped later anyway.
    limits = {"min_model_size": MIN_IMAGES, "min_num_matches": MIN_MATCHES}
    mapper = _mapper_options(graph, config.threads)
    if len(graph.images) > config.all_tracks:
        mapper.track_required_tracks_per_view = TRACKS_PER_IMAGE
    manager = pycolmap.ReconstructionManager()
    options = pycolmap.GlobalPipelineOptions({**common, **limits, "mapper": mapper})
    pycolmap.GlobalPipeline(options, database, manager).run()
    return [manager.get(number) for number in range(manager.size())]


def _mapper_options(graph: ViewGraph, threads: int) -> Any:
    """Return the settings of the global mapper for a graph."""
    seed = {"random_seed": SEED}
    # Each part has a separate random generator.
    parts = dict.fromkeys(
        ("rotation_averaging", "global_positioning", "retriangulation"), seed
    )
    mapper = {**seed, "num_threads": threads, **parts}
    # With some known cameras, the others must still be refined: those are restored afterwards.
    if len(graph.known) == len(graph.images):
        mapper["bundle_adjustment"] = {
            "refine_focal_length": False,
            "refine_extra_params": False,
        }
    return pycolmap.GlobalMapperOptions(mapper)


def refine_models(
    database: Any, graph: ViewGraph, threads: int, former: Sequence[SfmModel]
) -> list[Any]:
    """Return pycolmap's models with the cameras of a filled database and the poses of ``former``.

    Points are triangulated again. These are the last steps of the global mapper; its positions,
    which take most of its time, are not computed again.
    """
    options = pycolmap.DatabaseCacheOptions({"min_num_matches": MIN_MATCHES})
    cache = pycolmap.DatabaseCache.create(database, options)
    settings = _mapper_options(graph, threads)
    # The mapper does this itself.
    settings.bundle_adjustment.ceres.solver_options.num_threads = threads
    return [_refine(cache, model.colmap, settings) for model in former]


def _refine(cache: Any, former: Any, settings: Any) -> Any:
    """Return a model with the cameras of ``cache``, from the poses of pycolmap's model ``former``."""
    model = pycolmap.Reconstruction()
    model.load(cache)
    # Images have the same numbers in both. The cache has none without verified matches.
    for number in filter(model.exists_frame, sorted(former.reg_frame_ids())):
        model.frame(number).rig_from_world = former.frame(number).rig_from_world
        model.register_frame(number)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    for image in sorted(model.reg_image_ids()):
        mapper.triangulate_image(settings.retriangulation, image)
    options = pycolmap.IncrementalMapperOptions(
        {"random_seed": SEED, "num_threads": settings.num_threads}
    )
    # Adjust cameras and points in turn with the choice of points, until the model has converged
    mapper.iterative_global_refinement(
        MAX_REFINEMENTS,
        MIN_CHANGE,
        options,
        _least_squares(settings),
        settings.retriangulation,
    )
    _filter_points(mapper.observation_manager, model, settings)
    mapper.adjust_global_bundle(options, settings.bundle_adjustment)
    _filter_points(mapper.observation_manager, model, settings)
    mapper.end_reconstruction(False)
    model.update_point_3d_errors()
    return model


def _least_squares(settings: Any) -> Any:
    """Return the options of an adjustment while points come and go: least squares of all tracks; the
    robust loss comes last.
    """
    solver = {
        "num_threads": settings.num_threads,
        "max_num_iterations": ADJUSTMENT_ITERATIONS,
    }
    return pycolmap.BundleAdjustmentOptions(
        {"print_summary": False, "ceres": {"use_gpu": False, "solver_options": solver}}
    )


def _filter_points(observations: Any, model: Any, settings: Any) -> None:
    """Remove wrong and uncertain points from a model, by the limits of the global mapper."""
    normalised = pycolmap.ReprojectionErrorType.NORMALIZED
    observations.filter_points3D_with_large_reprojection_error(
        settings.max_normalized_reproj_error, set(model.point3D_ids()), normalised
    )
    observations.filter_points3D_with_small_triangulation_angle(
        settings.min_tri_angle_deg, set(model.point3D_ids())
    )


def _reconstruction(
    mapped: Sequence[Any], graph: ViewGraph, config: SceneConfig
) -> Reconstruction:
    """Return pycolmap's models with the user's cameras, without implausible images."""
    given_cameras = known_by_name(graph)
    # In a large scene, points of two views are too many.
    is_adjusted = bool(given_cameras) or len(graph.images) <= config.all_tracks
    for model in mapped:
        drop_flat_lenses(model, given_cameras, is_adjusted=is_adjusted)
        if is_adjusted:
            adjust(model, given_cameras)
        # A point behind a camera has no reprojection error.
        observations = pycolmap.ObservationManager(model)
        if observations.filter_observations_with_negative_depth():
            model.update_point_3d_errors()
    found = []
    for model in mapped:
        # Sorted, because pycolmap's containers have no fixed order
        numbers = sorted(model.reg_image_ids())
        named = [(model.images[number], graph.images[number - 1]) for number in numbers]
        found.append(sfm_model(model, named))
    models = filter_models(found)
    return Reconstruction(
        graph.names, models, "" if models else "the matches gave no plausible model"
    )


def sfm_model(found: Any, images: Iterable[tuple[Any, BatchImage]]) -> SfmModel:
    """Return pycolmap's model, with the registered ``images`` and ours of the same names."""
    registered = []
    for image, named in images:
        K = np.array(image.camera.calibration_matrix())
        # The centre of an image's first pixel is (0.5, 0.5) in COLMAP, and (0, 0) here.
        K[:2, 2] -= COLMAP_CENTRE_PX
        pose = np.asarray(image.cam_from_world().matrix())
        # Copies: the views would keep pycolmap's memory.
        camera = Camera(K, pose[:, :3].copy(), pose[:, 3].copy())
        points = int(image.num_points3D)
        registered.append(RegisteredImage(named, camera, points, lens_of(image.camera)))
    error = float(found.compute_mean_reprojection_error()) if found.num_points3D() else 0.0
    return SfmModel(tuple(registered), points_of(found), error, found)


def points_of(found: Any) -> NDArray[np.float64]:
    """Return the finite points (P, 3) of pycolmap's model, the longest tracks first."""
    tracks = {
        number: found.points3D[number].track.length()
        for number in sorted(found.point3D_ids())
    }
    # The sort is stable: of equally long tracks, the point with the lower id.
    longest_first = sorted(tracks, key=lambda number: -tracks[number])
    points = np.array([found.points3D[number].xyz for number in longest_first], np.float64)
    points = points.reshape(-1, 3)  # also without any point
    return points[np.isfinite(points).all(axis=1)]
