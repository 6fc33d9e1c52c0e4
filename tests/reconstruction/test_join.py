"""All folders below DIR as one dataset, with equal file names in several folders."""

import csv
import time
from math import inf
from pathlib import Path

import pycolmap
import pytest
from test_layout import load_as_gsplat
from test_reconstruct import FIRST, RECIPE, MixedMatcher, write_flat

from mkpc_kaggle.engine.plan.budget import Budget
from mkpc_kaggle.engine.session import Interrupt, Session
from mkpc_kaggle.engine.store.dataframes import results
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.reconstruction.folder import read_folder, read_pair_list
from mkpc_kaggle.reconstruction.layout import write_layouts
from mkpc_kaggle.reconstruction.outputs import write_tables
from mkpc_kaggle.reconstruction.run import FolderResult, reconstruct_folder
from mkpc_kaggle.setup.assembly import assemble


@pytest.fixture
def cards(tmp_path: Path) -> Path:
    """Six photographs of one scene on two cards of a camera, which counts from 1 on each."""
    root = tmp_path / "DCIM"
    files = sorted(write_flat(tmp_path / "flat", FIRST).iterdir())
    for number, file in enumerate(files):
        folder = root / ("100MEDIA" if number < 3 else "101MEDIA")
        folder.mkdir(parents=True, exist_ok=True)
        file.rename(folder / f"DJI_{number % 3 + 1:04}.png")
    return root


def run(root: Path, out: Path, *, join: bool) -> FolderResult:
    session = Session(
        out / "work", Budget(time.monotonic(), inf), Interrupt(), progress=False, workers=0
    )
    assembly = assemble(RECIPE, matchers={"synthetic": MixedMatcher()}, device="cpu")
    datasets = read_folder(root, join=join)
    result = reconstruct_folder(root, datasets, assembly, session, out)
    assert list(write_layouts(out, root, datasets, inf)) == []
    write_tables(out, result.cameras, root, "imc2025")
    return result


def test_joined_folders_are_one_model_with_all_images(tmp_path, cards):
    out = tmp_path / "out"
    run(cards, out, join=True)
    names = [f"{card}MEDIA/DJI_{n:04}.png" for card in (100, 101) for n in (1, 2, 3)]
    model = pycolmap.Reconstruction(out / "models" / "0")
    assert sorted(image.name for image in model.images.values()) == names
    # Other programs read links without folders.
    found = load_as_gsplat(out)
    assert found.names == [name.replace("/", "_") for name in names]
    for name, path in zip(names, found.paths, strict=True):
        assert path.read_bytes() == (cards / name).read_bytes()
    for table, column in (("cameras.csv", "image"), ("submission.csv", "image")):
        with (out / table).open() as stream:
            assert [row[column] for row in csv.DictReader(stream)] == names
    assert results(out / "work").scenes["cameras"].tolist() == [FIRST]


def test_folders_that_are_not_joined_are_two_datasets(tmp_path, cards):
    result = run(cards, tmp_path / "out", join=False)
    assert [len(found) for found in result.cameras.values()] == [3, 3]


def test_a_list_of_pairs_may_cross_joined_folders_only(tmp_path, cards):
    (tmp_path / "pairs.txt").write_text("100MEDIA/DJI_0001.png 101MEDIA/DJI_0001.png\n")
    joined = read_folder(cards, join=True)
    (ends,) = read_pair_list(tmp_path / "pairs.txt", cards, joined)
    assert [end.parent.name for end in ends] == ["100MEDIA", "101MEDIA"]
    with pytest.raises(UserError, match="expected two images of one dataset"):
        read_pair_list(tmp_path / "pairs.txt", cards, read_folder(cards))
