"""A native library that cannot be imported is one line, for commands and for programs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mkpc_kaggle.errors import require_native

ROOT = Path(__file__).resolve().parents[1]
# As NumPy 2 does for a library that was compiled with NumPy 1.
OLD = """\
import sys
sys.stderr.write('''
A module that was compiled using NumPy 1.x cannot be run in
NumPy 2.4.6 as it may crash. To support both 1.x and 2.x
versions of NumPy, modules must be compiled with NumPy 2.0.
''')
raise AttributeError("_ARRAY_API not found")
"""
NO_FILE = "raise ImportError('libGL.so.1: cannot open shared object file: No such file')\n"
CAUSES = {
    OLD: "compiled using NumPy 1.x cannot be run in NumPy 2.4.6 as it may crash; install it again",
    NO_FILE: "ImportError: libGL.so.1: cannot open shared object file",
}


def run_with(tmp_path: Path, library: str, *command: str) -> subprocess.CompletedProcess:
    (tmp_path / "cv2.py").write_text(library)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    return subprocess.run(
        [sys.executable, *command],
        check=False,
        capture_output=True,
        text=True,
        env=environment,
        cwd=tmp_path,
    )


@pytest.mark.parametrize("library", CAUSES)
def test_a_command_prints_one_line_and_ends_with_2(tmp_path, library):
    command = ["-m", "mkpc_kaggle", "check", "x.csv", "--test-dir", "."]
    done = run_with(tmp_path, library, *command)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("cv2 cannot be imported: ")
    assert CAUSES[library] in line


@pytest.mark.parametrize("library", CAUSES)
def test_a_program_gets_an_import_error_of_one_line(tmp_path, library):
    done = run_with(tmp_path, library, "-c", "from mkpc_kaggle import TwoStageMatcher")
    assert "NumPy 2.0" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("ImportError: cv2 cannot be imported: ")
    assert CAUSES[library] in last


def test_a_library_that_can_be_imported_keeps_its_words(tmp_path, monkeypatch, capsys):
    (tmp_path / "talking.py").write_text("import sys\nsys.stderr.write('hello')\n")
    monkeypatch.syspath_prepend(tmp_path)
    require_native("talking", "")
    assert capsys.readouterr().err == "hello"
