"""Every snippet of docs/folder.md runs, in the order of the page, after a folder has grown."""

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
from test_reconstruct import FIRST, run, write_flat

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "folder.md").read_text(
    encoding="utf-8"
)
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
*COLMAP, OURS = BLOCKS


def test_the_snippets_run_from_top_to_bottom(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    pinholes = {"scene.camera_model": "SIMPLE_PINHOLE"}
    run(write_flat(Path("DIR"), FIRST - 1), Path("OUT"), settings=pinholes)
    shutil.copytree("OUT/models/0", "OLD")
    former = pycolmap.Reconstruction("OLD")
    run(write_flat(Path("DIR"), FIRST), Path("OUT"), settings=pinholes)
    Path("NEW").mkdir()
    names: dict[str, object] = {}
    for block in COLMAP:
        exec(compile(block, f"docs/folder.md: {block.splitlines()[0]}", "exec"), names)
    said = capsys.readouterr().out
    assert f"num_reg_frames = {FIRST}" in said
    assert "00.png 01.png (" in said
    assert names["errors"].get_cam_cov_from_world(3).shape == (6, 6)
    grown = pycolmap.Reconstruction("NEW")
    assert grown.num_reg_images() == FIRST
    poses = {image.name: image.cam_from_world().matrix() for image in grown.images.values()}
    for image in former.images.values():
        pose = image.cam_from_world().matrix()
        np.testing.assert_allclose(pose, poses[image.name], atol=1e-12)
    assert list(pd.read_csv("submission.csv")["scene"]) == ["cluster0"] * FIRST


def test_the_call_of_the_page_runs(demo, tmp_path, monkeypatch, nowhere_else):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(demo.train_dir / "courtyard" / "images", "DIR")
    names: dict[str, object] = {}
    exec(compile(OURS, "docs/folder.md", "exec"), names)
    assert Path("OUT/report.html").exists()
