"""Calibrations of another resolution, by their principal points."""

import numpy as np
import pytest

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.resolution import doubt_about_resolution

SIZE = Size(640, 428)


def matrix(x: float, y: float) -> np.ndarray:
    return np.array([[575.0, 0, x], [0, 575, y], [0, 0, 1]])


@pytest.mark.parametrize(
    ("point", "words"),
    {
        (319.5, 213.5): "",
        (350.0, 200.0): "",  # of a lens that is not centred
        (
            639.5,
            427.5,
        ): "is outside of an image of 640 x 428 pixels; the matrix seems to be for 1280 x 856",
        (
            159.5,
            106.5,
        ): "is far from the middle of an image of 640 x 428 pixels; the matrix seems to be for 320 x 214",
        (213.5, 319.5): "the matrix seems to be for 428 x 640",
        (
            0.0,
            0.0,
        ): "the principal point 0.5, 0.5 is far from the middle of an image of 640 x 428 pixels",
        (-9.0, 213.5): "the principal point -8.5, 214 is outside of an image",
    }.items(),
)
def test_a_matrix_for_another_resolution_is_doubted(point, words):
    doubt = doubt_about_resolution(matrix(*point), SIZE)
    assert words in doubt
    assert bool(words) == bool(doubt)
