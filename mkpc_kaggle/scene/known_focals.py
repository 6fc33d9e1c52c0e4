"""F of a pair that the scene gives none, from its own matches, at the focal lengths that the scene knows."""

from collections.abc import Sequence
from dataclasses import dataclass

from mkpc_kaggle.geometry.focal_prior import FocalConfig, FocalPrior, estimate_with_prior
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Matrix3, RobustConfig
from mkpc_kaggle.scene.batch import BatchImage
from mkpc_kaggle.scene.choose import placed_in
from mkpc_kaggle.scene.model import Model
from mkpc_kaggle.scene.one_camera import OneCameras, camera_of


@dataclass(frozen=True)
class KnownFocals:
    """How F is estimated: ``magsac`` and ``focal`` are those of a pair alone, but the log focal length of an image
    that has a camera in a model, or is by one camera with others, has the standard deviation ``sigma``.
    """

    magsac: RobustConfig
    focal: FocalConfig
    sigma: float

    def fundamental(
        self,
        models: Sequence[Model],
        cameras: OneCameras,
        image0: BatchImage,
        image1: BatchImage,
        matches: Matches,
    ) -> Matrix3 | None:
        """F, (3, 3); ``None`` where neither focal length is known or the matches give none."""
        focals = focal_of(models, cameras, image0), focal_of(models, cameras, image1)
        if focals == (None, None):
            return None
        first, second = (
            FocalPrior.of_image(image.size, self.focal)
            if focal is None
            else FocalPrior.of_focal(focal, self.sigma, image.size)
            for image, focal in zip((image0, image1), focals, strict=True)
        )
        found = estimate_with_prior(matches, (first, second), self.magsac, self.focal)
        return found.matrix if found.ok else None


def focal_of(models: Sequence[Model], cameras: OneCameras, image: BatchImage) -> float | None:
    """The focal length, in pixels, of an image's camera: the first model's, or one that took others too."""
    placed = [found for model in models if (found := placed_in(model, image.name)) is not None]
    if placed:
        return placed[0].focal
    camera = camera_of(cameras, image.name, image.size)
    return camera.focal if camera else None
