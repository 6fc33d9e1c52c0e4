"""A match draws itself."""

import cv2
import pytest
from sklearn.datasets import load_sample_image

from mkpc_kaggle import TwoStageMatcher
from mkpc_kaggle.recipe import Recipe, Unit

pytestmark = pytest.mark.usefixtures("nowhere_else")


def photographs(shift=30):
    whole = load_sample_image("china.jpg")
    return whole[60:300, 60:400], whole[60:300, 60 + shift : 400 + shift]


def test_a_match_plots_itself_on_its_images(tmp_path):
    pytest.importorskip("matplotlib")
    images = photographs()
    for name, image in zip("ab", images, strict=True):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image[..., ::-1])
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    match = TwoStageMatcher(Recipe((Unit(1, "sift", 320), Unit(2, "sift", 320))))(*files)
    for given in (files, images):
        figure = match.plot(*given)
        assert f"{match.estimate.inlier_count} inliers" in figure.axes[0].get_title(
            loc="left"
        )
        assert len(figure.axes[0].images) == 2
    figure.savefig(tmp_path / "x.png")
