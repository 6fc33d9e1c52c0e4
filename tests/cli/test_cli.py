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
    code = (
        "import sys, pkgutil, importlib, mkpc_kaggle\n"
        "print([m for m in ('torch', 'cv2', 'numpy') if m in sys.modules])\n"
        "import mkpc_kaggle.geometry as g, mkpc_kaggle.weights\n"
        "[importlib.import_module(f'{g.__name__}.{m.name}') for m in pkgutil.iter_modules(g.__path__)]\n"
        "print('torch' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.split() == ["[]", "False"]


def test_a_reader_that_leaves_ends_the_command_quietly():
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as out:
        command = [sys.executable, "-m", "mkpc_kaggle", "recipes"]
        done = subprocess.run(command, stdout=out, stderr=subprocess.PIPE, check=False)
    assert (done.returncode, done.stderr) == (141, b"")


def test_recipes_are_listed_with_what_they_lack(clean_environment, capsys):
    assert run_command("recipes") == 0
    out = capsys.readouterr().out
    light = out[out.index("light: ") :]
    assert "xfeat_lighterglue: no weights (xfeat: xfeat.pt or xfeat_sparse_bnfolded.safetensors" in light
    classical = out[out.index("classical: ") : out.index("light: ")]
    assert "all weights are available" in classical
    assert "    2:dkm@630x840  at most 4096\n" in out
    assert "    1:aliked_lightglue@1024  at most 4096  (or aliked, if its weights are missing)\n" in light


def test_check_tells_good_from_bad(demo, tmp_path, capsys):
    ids = [pair.id for pair in read_test_side(demo.test_dir)]
    path = tmp_path / "submission.csv"
    write_submission(path, dict.fromkeys(ids, FALLBACK_FUNDAMENTAL))
    assert run_command("check", path, "--test-dir", demo.test_dir) == 0
    assert "good: 8 rows" in capsys.readouterr().out
    write_submission(path, dict.fromkeys(ids[1:], np.full((3, 3), np.nan)))
    assert run_command("check", path, "--test-dir", demo.test_dir) == 1
    assert "1 samples are missing" in capsys.readouterr().out
    assert run_command("check", path, "--test-dir", tmp_path) == 2


def match_arguments(demo: DemoSet, recipe: Path, out: Path) -> list[str]:
    images = sorted((demo.train_dir / "courtyard" / "images").iterdir())[:2]
    return ["match", *map(str, images), "--recipe", str(recipe), "--out", str(out)]


def test_match_prints_f_and_draws_the_pair(demo, small_recipe, tmp_path, capsys):
    figure = tmp_path / "new" / "pair.png"
    assert run_command(*match_arguments(demo, small_recipe, figure)) == 0
    out = capsys.readouterr().out.splitlines()
    F = np.array([[float(value) for value in line.split()] for line in out[:3]])
    assert np.linalg.norm(F) == pytest.approx(1)
    assert "1:sift@320" in "\n".join(out)
    assert cv2.imread(str(figure)).shape[1] > 1000


def test_matplotlib_leaves_nothing_where_home_cannot_be_written(demo, small_recipe, tmp_path):
    (tmp_path / "tmp").mkdir()
    home = {"HOME": "/proc/home", "XDG_CONFIG_HOME": "/proc/home", "TMPDIR": str(tmp_path / "tmp")}
    command = [sys.executable, "-m", "mkpc_kaggle", *match_arguments(demo, small_recipe, tmp_path / "pair.png")]
    environment = {name: value for name, value in os.environ.items() if name != "MPLCONFIGDIR"} | home
    subprocess.run(command, env=environment, check=True)
    assert list((tmp_path / "tmp").iterdir()) == []


def test_match_draws_a_pair_that_has_nothing_in_common(clean_environment, tmp_path, capsys):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((60, 90, 3), 127, np.uint8))
    match, figure = ["match", *[tmp_path / "a.png"] * 2], tmp_path / "pair.png"
    assert run_command(*match, "--licence", "permissive", "--out", figure) == 0
    assert "this is the fallback: too few distinct matches" in capsys.readouterr().out
    assert figure.exists()


def test_what_a_command_printed_has_been_flushed_when_it_ends_however_long_a_reader_takes(monkeypatch):
    class Flushed(StringIO):
        def flush(self) -> None:
            self.whole = self.getvalue(), threading.current_thread()

    monkeypatch.setattr(sys, "stdout", stream := Flushed())
    assert run_command("recipes") == 0
    assert stream.whole == (stream.getvalue(), threading.main_thread())  # a thread would not be waited for
    assert "auto: " in stream.getvalue()
