"""Pairs of a folder: all of a few photographs, the most similar ones of many."""

from itertools import combinations
from math import inf
from pathlib import Path

import cv2
import pytest
from sklearn.datasets import load_sample_image

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.reconstruction import pairs
from mkpc_kaggle.reconstruction.pairs import choose_pairs
from mkpc_kaggle.scene import likeness
from mkpc_kaggle.scene.likeness import local_features, shortlist


@pytest.fixture
def photographs(tmp_path: Path) -> list[Path]:
    """Overlapping parts of two photographs, one after the other."""
    paths = []
    for name in ("china.jpg", "flower.jpg"):
        picture = load_sample_image(name)[..., ::-1]
        for number in range(6):
            paths.append(tmp_path / f"{name[:-4]}{number}.png")
            part = picture[20 + number : 360 + number, 12 * number : 12 * number + 420]
            cv2.imwrite(str(paths[-1]), part)
    return paths


def test_a_shortlist_has_images_that_are_alike_and_none_that_cannot_be_read(
    photographs, tmp_path, monkeypatch
):
    features = [*map(local_features, photographs)]
    monkeypatch.setattr(likeness, "PARTNERS", 3)
    found = shortlist(features)
    # Large folders are compared in parts.
    monkeypatch.setattr(likeness, "COMPARED_AT_A_TIME", 2)
    assert shortlist(features) == found
    assert found == sorted(set(found))
    assert all((i < 6) == (j < 6) and i < j for i, j in found)
    assert {index for pair in found for index in pair} == set(range(12))
    # Without features, images are in the order of their names.
    nothing = [local_features(tmp_path / f"none{number}.png") for number in range(3)]
    monkeypatch.setattr(likeness, "PARTNERS", 1)
    assert shortlist(nothing) == [(0, 1), (0, 2)]


def test_the_pairs_of_a_large_folder_are_chosen_once(photographs, tmp_path, monkeypatch):
    assert choose_pairs(photographs, tmp_path, inf) == list(combinations(photographs, 2))
    monkeypatch.setattr(pairs, "MAX_IMAGES", 3)
    found = choose_pairs(photographs, tmp_path, inf)
    assert set(found) <= set(combinations(photographs, 2))
    # A second call compares nothing, until a photograph changes.
    assert choose_pairs(photographs, tmp_path, -inf) == found
    photographs[0].unlink()
    with pytest.raises(UserError, match="were not compared: no time was left"):
        choose_pairs(photographs, tmp_path, -inf)
