"""A stand-in of the interface of the package ``lightglue``, with this package's RootSIFT behind it."""

from types import ModuleType
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from mkpc_kaggle import TwoStageMatcher


def load_image(path: str) -> Tensor:
    """(3, H, W) floats in 0..1, RGB."""
    pixels = cv2.imread(path)[..., ::-1]
    return torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1) / 255


def rbd(data: dict[str, Any]) -> dict[str, Any]:
    """Remove the dimension of the batch."""
    return {key: value[0] for key, value in data.items()}


class Extractor:
    def __init__(self, max_num_keypoints: int) -> None:
        self.most = max_num_keypoints

    def eval(self) -> "Extractor":
        return self

    def extract(self, image: Tensor) -> dict[str, Tensor]:
        # All matching is done below; an image with itself gives its keypoints.
        kept = TwoStageMatcher("sift")(image, image).keypoints
        return {"keypoints": torch.from_numpy(kept.points0)[None], "image": image[None]}


class Glue:
    def __init__(self, features: str) -> None:
        self.features = features

    def eval(self) -> "Glue":
        return self

    def __call__(self, data: dict[str, dict[str, Tensor]]) -> dict[str, list[Tensor]]:
        images = (data["image0"]["image"][0], data["image1"]["image"][0])
        match = TwoStageMatcher("sift")(*images)
        indices = torch.from_numpy(match.keypoints.indices)
        return {"matches": [indices], "scores": [torch.from_numpy(match.matches.scores)]}


def stand_in() -> dict[str, ModuleType]:
    """The modules by name, for ``sys.modules``."""
    package = ModuleType("lightglue")
    utils = ModuleType("lightglue.utils")
    viz2d = ModuleType("lightglue.viz2d")
    package.__dict__.update(ALIKED=Extractor, LightGlue=Glue, utils=utils, viz2d=viz2d)
    utils.__dict__.update(load_image=load_image, rbd=rbd)
    viz2d.__dict__.update(plot_images=lambda images: None, plot_matches=lambda *points: None)
    return {"lightglue": package, "lightglue.utils": utils, "lightglue.viz2d": viz2d}
