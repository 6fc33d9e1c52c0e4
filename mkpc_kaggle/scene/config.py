"""Settings of the reconstruction: the table ``[scene]`` of a recipe."""

from dataclasses import dataclass
from enum import StrEnum

from mkpc_kaggle.config import AT_LEAST_0, AT_LEAST_1, POSITIVE, SHARE, Range, check_ranges


class Mapper(StrEnum):
    """The two mappers of pycolmap: image by image, or all rotations and then all positions at once."""

    INCREMENTAL = "incremental"
    GLOBAL = "global"


class CameraModel(StrEnum):
    """COLMAP's models of one focal length, the principal point at the centre; RADIAL has a distortion too."""

    PINHOLE = "SIMPLE_PINHOLE"
    RADIAL = "SIMPLE_RADIAL"


@dataclass(frozen=True)
class SceneConfig:
    """Settings of :func:`mkpc_kaggle.scene.solve.solve`.

    Keypoints: ``cell``, in pixels, is what points of an image are merged in; a pair with fewer matches than
    ``least_tracks`` of units that make tracks gives those of all its units. Verification of a pair's matches:
    ``verification_error`` in pixels, and the ``least_inliers`` that it needs. Cameras: ``camera_model``, and the
    focal length that they start with, ``prior_focal`` long sides. With ``each_matcher``, what each matcher found
    is reconstructed alone, too; a pair gets the mean of its cameras that are within ``agreement`` degrees.

    One camera: where more than half of ``one_camera_images`` or more of one size have focal lengths within a
    share of ``one_camera`` of their median, the scene is made anew with one camera for that size, but for images
    that are not within and see ``one_camera_weak`` times as many points as the median image, or more. It stays if
    images see points ``one_camera_points`` times as often as before, or more. ``one_camera = 0``: never.

    A scene has ``least_images``, and ``least_pairs_per_image`` times as many connected pairs: with fewer there is
    little that could contradict its cameras. A batch that has fewer pairs than ``pairs_per_image`` for each of its
    images gets others that no row names, matched by the recipe's first unit; 0: none. Above ``most_images`` it
    gets none, and is reconstructed in overlapping parts, by the incremental mapper whatever ``mapper`` says.

    A pair that the scene gives no F is estimated anew from its own matches: ``focal_sigma`` is the standard
    deviation of the logarithm of a focal length that the scene found, where the recipe has a prior on them.

    Checks: an image's focal length is between ``lowest_focal`` and ``highest_focal`` long sides, and it sees
    ``least_points`` points. A pair keeps its own F if ``contradiction_matches`` of its matches are within
    ``contradiction_error`` pixels of it and the scene's has less than ``contradiction_share`` of as many.
    """

    mapper: Mapper = Mapper.GLOBAL
    camera_model: CameraModel = CameraModel.PINHOLE
    cell: float = 0.75
    least_tracks: int = 50
    each_matcher: bool = True
    agreement: float = 5.0
    one_camera: float = 0.02
    one_camera_images: int = 5
    one_camera_weak: float = 0.5
    one_camera_points: float = 0.99
    verification_error: float = 1.0
    least_inliers: int = 15
    prior_focal: float = 1.1
    least_images: int = 3
    least_pairs_per_image: float = 1.35
    pairs_per_image: float = 5.0
    most_images: int = 500
    lowest_focal: float = 0.3
    highest_focal: float = 5.0
    least_points: int = 30
    contradiction_error: float = 2.0
    contradiction_matches: int = 30
    contradiction_share: float = 0.05
    focal_sigma: float = 0.1
    seed: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        check_ranges(
            self,
            cell=POSITIVE,
            least_tracks=AT_LEAST_0,
            agreement=POSITIVE,
            one_camera=AT_LEAST_0,
            one_camera_images=Range(3),
            one_camera_weak=AT_LEAST_0,
            one_camera_points=AT_LEAST_0,
            verification_error=POSITIVE,
            least_inliers=Range(8),
            prior_focal=POSITIVE,
            least_images=Range(3),
            least_pairs_per_image=AT_LEAST_0,
            pairs_per_image=AT_LEAST_0,
            most_images=Range(3),
            lowest_focal=POSITIVE,
            highest_focal=POSITIVE,
            least_points=AT_LEAST_0,
            contradiction_error=POSITIVE,
            contradiction_matches=AT_LEAST_1,
            contradiction_share=SHARE,
            focal_sigma=POSITIVE,
            seed=Range(0, 2**31 - 1),
            threads=AT_LEAST_1,
        )
        if self.lowest_focal >= self.highest_focal:
            raise ValueError(f"lowest_focal {self.lowest_focal} is not below highest_focal {self.highest_focal}")
