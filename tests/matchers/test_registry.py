"""The template of a matcher runs as a file of the package and as a program."""

import subprocess
import sys
from pathlib import Path

from pictures import write_two_views

TEMPLATE = Path(__file__).parents[2] / "docs" / "own_matcher.py"


def test_the_template_of_a_matcher_runs_as_a_program(tmp_path):
    write_two_views(tmp_path)
    command = [sys.executable, TEMPLATE, "a.jpg", "b.jpg"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    count = int(done.stdout.split(" inliers")[0])
    assert count > 100
