"""The tables of a run hold what their columns say, in every run."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from rectified import SWEEP, RectifiedMatcher, run, write_pairs

from mkpc_kaggle import results
from mkpc_kaggle.recipe import Recipe

RECIPE = Recipe((SWEEP,))


@pytest.fixture(scope="module")
def work(tmp_path_factory) -> Path:
    """A run over two pairs of folders with the same file names."""
    home = tmp_path_factory.mktemp("tables")
    first, second = write_pairs(home / "left", 2)
    shutil.copytree(home / "left", home / "right")
    moved = replace(second, file0=first.file0.replace("left", "right"))
    run([first, moved], RECIPE, RectifiedMatcher(), home / "work")
    return home / "work"


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
        "image",
        "model",
        "width",
        "height",
        "focal",
    ]
    assert tables.cameras.query("focal > 0").empty
    joined = tables.pairs.merge(
        tables.cameras, left_on="image0", right_on="image", how="left"
    )
    assert joined["focal"].isna().all()
