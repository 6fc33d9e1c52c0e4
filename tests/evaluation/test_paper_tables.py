"""The paper's tables in one command."""

from dataclasses import replace

import numpy as np
from pair_lists import write_list

from benchmarks import paper_tables
from mkpc_kaggle.data.competition import read_train_side


def test_the_papers_tables_are_made_with_one_command(demo, tmp_path, capsys):
    (scene,) = read_train_side(demo.train_dir)
    one_pair = replace(scene, pairs=scene.pairs[:1])
    listed = write_list(tmp_path / "list.txt", [one_pair], demo.train_dir)
    train = str(demo.train_dir)
    tables = ["--yfcc", str(listed), train, "--imc", train, "--pairs", "1"]
    tables += ["--out", str(tmp_path / "out"), "--matcher", "sift"]
    paper_tables.main([*tables, "--rows", "1600", "1200 + 1600", "loftr"])
    lines = []
    for line in capsys.readouterr().out.splitlines():
        lines.append([cell.strip() for cell in line.split("|")[1:-1]])
    yfcc = lines[:6]
    imc = lines[6:]
    names = ["1600 ransac", "1600 magsac", "1200 + 1600 magsac", "mean difference"]
    assert [" ".join(row[:2]).strip() for row in yfcc[2:]] == names
    # The paper's figures, in separate columns.
    assert yfcc[2][7:] == ["37.73", "58.03", "74.57", "1"]
    assert [row[10] for row in yfcc[2:5]] == ["1", "0", "2"]  # the unit that two rows have ran once
    own = np.array([row[2:5] for row in yfcc[2:5]], float)
    published = np.array([row[7:10] for row in yfcc[2:5]], float)
    difference = np.array(yfcc[5][7:10], float)
    # Both sides are rounded to a hundredth.
    np.testing.assert_allclose(difference, (own - published).mean(axis=0), atol=0.006)
    assert imc[2][0] == "loftr"
    assert imc[2][3:] == ["0.75478", "0.75606", "1"]
