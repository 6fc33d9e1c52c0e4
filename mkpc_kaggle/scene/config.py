"""Settings of the reconstruction: the table ``[scene]`` of a recipe."""

from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from mkpc_kaggle.config import AT_LEAST_0, AT_LEAST_1, check_ranges


class CameraModel(StrEnum):
    """COLMAP's models of one focal length, the principal point at the centre; RADIAL has a distortion too."""

    PINHOLE = "SIMPLE_PINHOLE"
    RADIAL = "SIMPLE_RADIAL"


@dataclass(frozen=True)
class SceneConfig:
    """Settings of :func:`mkpc_kaggle.scene.reconstruct.reconstruct_batch` and the batch's view graph."""

    camera_model: CameraModel = CameraModel.PINHOLE
    each_matcher: bool = True  # also reconstruct each matcher's matches alone; a pair gets the mean of its cameras
    shared_intrinsics: float = 0.02  # images of one size share a camera if most focals are this close; 0: never
    pairs_per_image: float = 5.0  # a batch with fewer pairs gets extra pairs, for its scene alone; 0: none
    threads: int = 1  # more than one: the last digits differ from run to run

    FORMER: ClassVar = {"one_camera": "shared_intrinsics"} | dict.fromkeys((
        "mapper", "cell", "least_tracks", "agreement", "one_camera_images", "one_camera_weak", "one_camera_points",
        "least_inliers", "prior_focal", "least_images", "least_pairs_per_image", "most_images", "lowest_focal",
        "highest_focal", "least_points", "contradiction_error", "contradiction_matches", "contradiction_share",
        "verification_error", "focal_sigma", "seed",
    ), "")  # fmt: skip

    def __post_init__(self) -> None:
        check_ranges(self, shared_intrinsics=AT_LEAST_0, pairs_per_image=AT_LEAST_0, threads=AT_LEAST_1)
