"""The tables of a run hold what their columns say, in every run."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rectified import SWEEP, RectifiedMatcher, run, write_pairs

from mkpc_kaggle import results
from mkpc_kaggle.recipe import Recipe

RECIPE = Recipe((SWEEP,))
K = np.array([[90.0, 0, 39.5], [0, 90, 35.5], [0, 0, 1]])


@pytest.fixture(scope="module")
def work(tmp_path_factory) -> Path:
    """A run over two pairs of folders with the same file names, one of them with intrinsics."""
    home = tmp_path_factory.mktemp("tables")
    first, second = write_pairs(home / "left", 2)
    shutil.copytree(home / "left", home / "right")
    moved = replace(second, file0=first.file0.replace("left", "right"), intrinsics=(K, K))
    run([first, moved], RECIPE, RectifiedMatcher(), home / "work")
    return home / "work"


def matrix(row) -> np.ndarray:
    return np.array([[float(row[f"f{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)])


def test_the_model_of_a_pair_says_whether_its_matrix_is_f_or_e(work):
    pairs = results(work).pairs
    assert pairs["model"].tolist() == ["F", "E"]
    # The pictures are rectified, so F and E are [e_x]x of pixels and of calibrated points.
    singular = [np.linalg.svd(matrix(row), compute_uv=False) for _, row in pairs.iterrows()]
    np.testing.assert_allclose(singular[1] / singular[1][0], [1, 1, 0], atol=1e-6)


def test_images_of_one_file_name_have_two_names(work):
    names = results(work).pairs["image0"].tolist()
    assert [Path(name).name for name in names] == ["000_0.png", "000_0.png"]
    assert [Path(name).parent.name for name in names] == ["left", "right"]


def test_tables_without_rows_have_their_columns(work):
    """Of a run without scenes; a table with rows has the same columns."""
    tables = results(work)
    assert len(tables.cameras) == 0
    assert list(tables.cameras.columns[:6]) == [
        "batch",
        "model",
        "image",
        "width",
        "height",
        "focal",
    ]
    assert tables.cameras.query("focal > 0").empty
    joined = tables.pairs.merge(tables.cameras, left_on="image0", right_on="image", how="left")
    assert joined["focal"].isna().all()
