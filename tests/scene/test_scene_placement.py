"""Cameras of a finished model that its photographs contradict."""

import numpy as np
import pycolmap

from benchmarks.synthetic_scene import synthetic_scene
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.placement import misplaced_images
from mkpc_kaggle.scene.sfm import reconstruct_batch


class Correspondences:
    """The same 200 matches between pairs of images."""

    def __init__(self, *pairs: tuple[int, int]) -> None:
        self.pairs = {pycolmap.image_pair_to_pair_id(*pair): 200 for pair in pairs}
        self.asked: list[tuple[int, int]] = []

    def num_matches_between_all_images(self) -> dict[int, int]:
        return self.pairs

    def extract_matches_between_images(self, first: int, second: int) -> np.ndarray:
        self.asked.append((first, second))
        return np.repeat(np.arange(200)[:, None], 2, axis=1)


def test_cameras_at_one_place_contradict_nothing():
    (found,) = reconstruct_batch(
        synthetic_scene(4, points=500).pairs, SceneConfig()
    ).reconstructions
    model = pycolmap.Reconstruction(found.models[0].colmap)
    first, second, third, fourth = sorted(model.reg_image_ids())
    model.frames[model.images[second].frame_id].rig_from_world = model.images[
        first
    ].cam_from_world()
    # Only pairs with matches are looked at, of images of the finished model.
    matched = Correspondences((first, second), (second, third))
    assert misplaced_images(model, matched, [first, second, fourth]) == set()
    assert matched.asked == [(first, second)]
