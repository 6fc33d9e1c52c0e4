"""The pair of images that comes nearest to joining two models of a scene."""

import numpy as np
import pytest

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.store.records import PairRecord, SceneRecord, UnitRecord
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


def record(first: str, second: str, inliers: int) -> PairRecord:
    pair = Pair(f"{first}{second}", "scene", f"{first}.jpg", f"{second}.jpg")
    unit = UnitRecord("1:sift@640", 1, 2 * inliers, inliers, 0, 0, "")
    return PairRecord(0, pair, failure="", units=(unit,))


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
    records = [record(*pair) for pair in pairs]
    assert nearest_to_joining(scene, records, digests) == told
