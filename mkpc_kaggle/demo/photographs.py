"""The two photographs that scenes are textured with, and pieces cut out of them.

Pictures are (H, W, 3) uint8 BGR; sizes are (width, height) in texels.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from mkpc_kaggle.demo.texture import Picture

Box = tuple[int, int, int, int]  # left, top, right, bottom

# Where things are in the photographs.
PAGODA: Box = (62, 28, 356, 380)
TIERS: tuple[Box, ...] = ((70, 246, 350, 366), (84, 164, 330, 248), (98, 62, 316, 166))  # from the ground up
FACADE: Box = (84, 170, 340, 345)
LATTICE: Box = (110, 192, 222, 222)
TREES: Box = (430, 305, 640, 427)
DAHLIA: Box = (168, 84, 446, 358)


@dataclass(frozen=True, eq=False)
class Photographs:
    china: Picture
    flower: Picture


def load_photographs() -> Photographs:
    """The two sample photographs of scikit-learn, 640 x 427."""
    from sklearn.datasets import load_sample_images

    images = load_sample_images().images
    china, flower = (np.ascontiguousarray(image[..., ::-1]) for image in images)
    return Photographs(china, flower)


def crop(photograph: Picture, box: Box, size: tuple[int, int]) -> Picture:
    left, top, right, bottom = box
    cut = cv2.resize(photograph[top:bottom, left:right], size, interpolation=cv2.INTER_CUBIC)
    return np.asarray(cut, dtype=np.uint8)


def random_cut(rng: np.random.Generator, photographs: Photographs, size: tuple[int, int]) -> Picture:
    """A piece with much texture of one of the photographs, mirrored or not, tinted."""
    busy = [(photographs.china, PAGODA), (photographs.china, TREES), (photographs.flower, DAHLIA)]
    photograph, (left, top, right, bottom) = busy[int(rng.integers(len(busy)))]
    share = rng.uniform(0.35, 0.75)
    w, h = int((right - left) * share), int((bottom - top) * share)
    x, y = int(rng.integers(left, right - w + 1)), int(rng.integers(top, bottom - h + 1))
    cut = crop(photograph, (x, y, x + w, y + h), size)
    if rng.random() < 0.5:
        cut = cut[:, ::-1]
    # Some of the colour as it is, some faded, some with the channels swapped.
    mix = 0.45 * np.eye(3) + 0.1 + 0.25 * np.eye(3)[rng.permutation(3)]
    return np.asarray(cv2.transform(cut, rng.uniform(0.7, 1.15, (3, 1)) * mix), dtype=np.uint8)
