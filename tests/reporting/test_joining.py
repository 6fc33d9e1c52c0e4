"""The pair of images that comes nearest to joining two models of a scene."""

import numpy as np
import pytest
from run_tables import Described, tables_of

from mkpc_kaggle.engine.store.tables import SceneRecord
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.reporting.verdict import nearest_to_joining
from mkpc_kaggle.scene.models import RegisteredImage, SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage


def model(*names: str) -> SfmModel:
    images = []
    for name in names:
        image = BatchImage(f"{name}.jpg", f"digest of {name}", Size(10, 10))
        images.append(RegisteredImage(image, Camera(np.eye(3), np.eye(3), np.zeros(3)), 5))
    return SfmModel(tuple(images), np.zeros((0, 3)), 0.5)


def described(first: str, second: str, inliers: int) -> Described:
    images = (f"{first}.jpg", f"{second}.jpg")
    return Described(f"{first}{second}", images, "scene", matches=2 * inliers, inliers=inliers)


# Images a, b and c are one model, d and e another; f has no camera.
CASES = {
    "most inliers between the models": (
        [("a", "b", 900), ("a", "d", 12), ("c", "e", 31), ("b", "e", 30)],
        "c.jpg and e.jpg (31 inliers)",
    ),
    "an image without a camera joins nothing": (
        [("a", "f", 50), ("d", "f", 60), ("b", "d", 1)],
        "b.jpg and d.jpg (1 inlier)",
    ),
    "no pair between the models": ([("a", "b", 900), ("a", "d", 0)], ""),
}


@pytest.mark.parametrize(("pairs", "told"), CASES.values(), ids=CASES)
def test_the_pair_with_the_most_inliers_between_two_models_is_named(pairs, told):
    scene = SceneRecord("scene", models=(model("a", "b", "c"), model("d", "e")))
    digests = {f"{name}.jpg": f"digest of {name}" for name in "abcdef"}
    table = tables_of(*(described(*pair) for pair in pairs)).pairs
    assert nearest_to_joining(scene, table, digests) == told
