"""Which cameras of a reconstruction to believe: what is absurd is left out, with a sentence that says why."""

import numpy as np

from mkpc_kaggle.config import Range
from mkpc_kaggle.scene.config import SceneConfig
from mkpc_kaggle.scene.model import Model, PlacedImage


def believable(models: tuple[Model, ...], config: SceneConfig) -> tuple[tuple[Model, ...], tuple[str, ...]]:
    """The models without the images that cannot be right, the largest first, and what was left out and why."""
    kept, doubts = [], []
    for model in models:
        wrong = [(image, doubt_of(image, config)) for image in model.images]
        doubts += [f"image {image.name}: {doubt}" for image, doubt in wrong if doubt]
        images = tuple(image for image, doubt in wrong if not doubt)
        if len(images) < config.least_images:
            doubts.append(f"a model of {len(images)} images is too small")
        else:
            kept.append(Model(images, model.points, model.reprojection_error))
    return tuple(sorted(kept, key=lambda model: -len(model.images))), tuple(doubts)


def doubt_of(image: PlacedImage, config: SceneConfig) -> str:
    """Why an image's camera cannot be right, or an empty string."""
    camera = image.camera
    if not all(np.isfinite(part).all() for part in (camera.K, camera.R, camera.t)):
        return "its camera is not finite"
    focals = Range(config.lowest_focal, config.highest_focal)
    if image.relative_focal not in focals:
        return f"its focal length is {image.relative_focal:.3g} long sides, outside of {focals}"
    if image.points < config.least_points:
        return f"it sees {image.points} points, fewer than {config.least_points}"
    return ""
