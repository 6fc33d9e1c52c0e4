"""The lines of pycolmap on docs/folder.md run on COLMAP's files of our runs."""

import re
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from benchmarks.synthetic_scene import synthetic_scene
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.export import HeldDirectory
from mkpc_kaggle.scene.sfm import reconstruct_graph
from mkpc_kaggle.scene.view_graph import ViewGraph

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "folder.md").read_text(encoding="utf-8")
BLOCKS = [
    block
    for block in re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
    if "import pycolmap" in block
]


@pytest.fixture
def names(tmp_path, monkeypatch) -> dict:
    """A working directory with DIR, and with OUT of six images (OLD) and of eight (NEW)."""
    scene = synthetic_scene(8, points=500)
    for out, count in (("OLD", 6), ("NEW", 8)):
        pairs = [pair for pair in scene.pairs if int(pair.image1.name) < count]
        graph = ViewGraph.of_pairs(pairs)
        reconstruct_graph(graph, SceneConfig(), HeldDirectory.of(tmp_path / out))
    (tmp_path / "DIR").mkdir()
    (tmp_path / "larger").mkdir()
    monkeypatch.chdir(tmp_path)
    return {}


def run(word: str, names: dict) -> None:
    (block,) = (block for block in BLOCKS if word in block)
    exec(compile(block, "docs/folder.md", "exec"), names)


def test_new_images_are_registered_among_cameras_that_stay(names):
    run("incremental_mapping", names)
    old = pycolmap.Reconstruction("OLD/models/0")
    new = pycolmap.Reconstruction("larger")
    assert (old.num_reg_images(), new.num_reg_images()) == (6, 8)
    for image in old.images.values():
        pose = new.find_image_with_name(image.name).cam_from_world()
        np.testing.assert_allclose(pose.params, image.cam_from_world().params, atol=1e-12)
