"""The paper's tables in one command."""

from dataclasses import replace

import numpy as np
import pytest
from pair_lists import write_list

from benchmarks import paper_tables
from mkpc_kaggle.data.competition import read_train_side


@pytest.mark.slow
def test_the_papers_tables_are_made_with_one_command(demo, tmp_path, capsys):
    (scene,) = read_train_side(demo.train_dir)
    one_pair = replace(scene, pairs=scene.pairs[:1])
    listed = write_list(tmp_path / "list.txt", [one_pair], demo.train_dir)
    train = str(demo.train_dir)
    tables = ["--yfcc", str(listed), train, "--imc", train, "--pairs", "1"]
    tables += ["--out", str(tmp_path / "out"), "--matcher", "sift"]
    paper_tables.main([*tables, "--rows", "1600", "1200 + 1600", "loftr"])
    rows = []
    for line in capsys.readouterr().out.splitlines():
        cells = line.split("|")[1:-1]
        rows.append([cell.strip() for cell in cells])
    # Each table has a head and a line below it.
    yfcc = rows[2:6]
    imc = rows[8]
    names = [" ".join(row[:2]).strip() for row in yfcc]
    assert names == ["1600 ransac", "1600 magsac", "1200 + 1600 magsac", "mean difference"]
    *scores, means = yfcc
    # The paper's figures, in separate columns.
    assert scores[0][7:10] == ["37.73", "58.03", "74.57"]
    # A unit that several rows have in common ran once.
    assert [row[10] for row in scores] == ["1", "0", "2"]
    own = np.array([row[2:5] for row in scores], float)
    published = np.array([row[7:10] for row in scores], float)
    difference = np.array(means[7:10], float)
    expected = (own - published).mean(axis=0)
    # Both sides are rounded to a hundredth.
    np.testing.assert_allclose(difference, expected, atol=0.006)
    assert imc[0] == "loftr"
    assert imc[3:] == ["0.75478", "0.75606", "1"]
