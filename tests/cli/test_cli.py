import os
import subprocess
import sys
import threading
from io import StringIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from shared import run_command

from mkpc_kaggle.data.competition import read_test_side, write_submission
from mkpc_kaggle.demo import DemoSet
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL


def test_importing_the_package_is_cheap_and_geometry_and_weights_bring_no_torch():
    # torch takes seconds to import, which `mkpc --help` and processes that estimate would all pay.
    code = (
        "import sys, pkgutil, importlib, mkpc_kaggle\n"
        "print([m for m in ('torch', 'cv2', 'numpy', 'pandas') if m in sys.modules])\n"
        "import mkpc_kaggle.geometry as g, mkpc_kaggle.weights\n"
        "for module in pkgutil.iter_modules(g.__path__):\n"
        "    importlib.import_module(f'{g.__name__}.{module.name}')\n"
        "print('torch' in sys.modules)"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "False"]


def test_a_reader_that_leaves_ends_the_command_quietly():
    # As `mkpc recipes | head -1`; 141 is the status that shells give to SIGPIPE.
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as out:
        command = [sys.executable, "-m", "mkpc_kaggle", "recipes"]
        env = {**os.environ, "PYTHONUNBUFFERED": ""}  # the output waits in a buffer
        done = subprocess.run(
            command, stdout=out, stderr=subprocess.PIPE, env=env, check=False
        )
    assert (done.returncode, done.stderr) == (141, b"")


def test_a_recipe_is_listed_with_its_units_and_missing_weights(clean_environment, capsys):
    assert run_command("recipes", "best") == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"  {'2:superglue@1280':<30}at most 4096 matches" in lines
    assert "superpoint: superpoint_v1.pth" in "\n".join(lines)
    # One matcher is a recipe; its weights are fetched by their slots.
    assert run_command("recipes", "aliked_lightglue") == 0
    listed = capsys.readouterr().out
    assert "1:aliked_lightglue@" in listed
    assert "`mkpc weights fetch aliked-n16 aliked-lightglue --out DIR`" in listed
    assert run_command("recipes", "classical") == 0
    assert "all weights are available" in capsys.readouterr().out


def test_check_accepts_a_whole_submission_and_refuses_one_with_a_missing_row(
    demo, tmp_path, capsys
):
    ids = [pair.id for pair in read_test_side(demo.test_dir)]
    path = tmp_path / "submission.csv"
    write_submission(path, dict.fromkeys(ids, FALLBACK_FUNDAMENTAL))
    assert run_command("check", path, "--test-dir", demo.test_dir) == 0
    assert "good: 8 rows" in capsys.readouterr().out
    write_submission(path, dict.fromkeys(ids[1:], np.full((3, 3), np.nan)))
    assert run_command("check", path, "--test-dir", demo.test_dir) == 1
    assert "was expected" in capsys.readouterr().out
    assert run_command("check", path, "--test-dir", tmp_path) == 2


def match_arguments(demo: DemoSet, recipe: Path, out: Path) -> list[str]:
    images = sorted((demo.train_dir / "courtyard" / "images").iterdir())[:2]
    return ["match", *map(str, images), "--recipe", str(recipe), "--out", str(out)]


def test_match_prints_f_and_draws_the_pair(demo, small_recipe, tmp_path, capsys):
    figure = tmp_path / "new" / "pair.png"
    assert run_command(*match_arguments(demo, small_recipe, figure)) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "F, by recipe small; x1^T F x0 = 0 in pixels of the stored files:"
    F = np.array([[float(value) for value in line.split()] for line in out[1:4]])
    assert np.linalg.norm(F) == pytest.approx(1)
    # Trailing blanks have been seen in this output.
    assert [line for line in out if line != line.rstrip()] == []
    assert "1:sift@320" in "\n".join(out)
    assert cv2.imread(str(figure)).shape[1] > 1000


@pytest.mark.filterwarnings("ignore:no F was found")
def test_match_draws_a_pair_that_has_nothing_in_common(clean_environment, tmp_path, capsys):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((60, 90, 3), 127, np.uint8))
    figure = tmp_path / "pair.png"
    match = ["match", tmp_path / "a.png", tmp_path / "a.png"]
    assert run_command(*match, "--out", figure) == 0
    assert "this is the fallback: too few distinct matches" in capsys.readouterr().out
    assert figure.exists()


def test_output_is_flushed_by_the_main_thread_before_a_command_ends(monkeypatch):
    class Flushed(StringIO):
        def flush(self) -> None:
            self.whole = self.getvalue(), threading.current_thread()

    monkeypatch.setattr(sys, "stdout", stream := Flushed())
    assert run_command("recipes") == 0
    # The process ends without waiting for its printing thread, and a slow reader would miss the end.
    assert stream.whole == (stream.getvalue(), threading.main_thread())
    assert "auto " in stream.getvalue()
