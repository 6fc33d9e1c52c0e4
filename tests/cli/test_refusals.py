"""Refusals of each command: in one line, with status 2, before any work, and without a change to a
file.
"""

import shutil
from pathlib import Path

import pytest
from shared import contents

from mkpc_kaggle.cli import main
from mkpc_kaggle.demo import write

SUBMIT = "submit --test-dir demo/test"
MATCH = "match x.png y.png --recipe classical --out"
# The message begins with the option or the file, and names the next step.
REFUSALS = [
    ("submit --test-dir nowhere", "test.csv: no such file"),
    (f"{SUBMIT} --recipe imaginary", "unknown recipe 'imaginary'; known: "),
    (f"{SUBMIT} --recipe light", "needs weights that were not found"),
    (f"{SUBMIT} --time-limit soon", "'soon' is not a duration"),
    (f"{SUBMIT} --output /dev/null/submission.csv", "cannot be written"),
    (f"{SUBMIT} --output /dev/null", "--output /dev/null is a device; name a file"),
    (f"{SUBMIT} --output .", "is a directory; name a file"),
    (f"{SUBMIT} --output {'s' * 300}.csv", "File name too long"),
    (f"{SUBMIT} --output demo/test/test.csv", "would overwrite the input demo/test/test.csv"),
    (f"{SUBMIT} --output link.csv", "would overwrite the input demo/test/test.csv"),
    # The same file by another name: a comparison of paths would miss it.
    (f"{SUBMIT} --output hard.csv", "would overwrite the input demo/test/test.csv"),
    (f"{SUBMIT} --output w/m.pth --weights w", "would overwrite the input w"),
    (
        f"{SUBMIT} --work-dir demo/test/test_images",
        "would overwrite the input demo/test/test_images",
    ),
    (
        f"{SUBMIT} --recipe small.toml --output small.toml",
        "would overwrite the input small.toml",
    ),
    (f"{SUBMIT} --output s.html", "would overwrite the report"),
    (
        f"{SUBMIT} --output w/journal.sqlite --work-dir w",
        "would overwrite the work directory",
    ),
    (
        "validate --train-dir demo/train --json demo/train/scaling_factors.csv",
        "would overwrite the input",
    ),
    (
        "validate --train-dir demo/train --compare auto small.toml:stage-1 --json small.toml",
        "would overwrite the input small.toml",
    ),
    (f"{MATCH} x.png", "would overwrite the input"),
    # matplotlib would add a suffix.
    (f"{MATCH} x", "needs a suffix"),
    # Settings have the same checks as a file of a recipe.
    (f"{SUBMIT} --set foo", "--set foo: expected TABLE.KEY=VALUE"),
    (
        f"{SUBMIT} --set mkpc.epsilon=1",
        "table [mkpc] has the unknown key 'epsilon'; known keys: eps, ",
    ),
    (f"{SUBMIT} --set mkpc.eps.x=0", "--set mkpc.eps.x: eps is a key, not a table"),
    (
        f"{SUBMIT} --set matchers.loftr.threshold=2",
        "[matchers.loftr]: threshold must be in [0, 1], not 2",
    ),
    (
        f"{SUBMIT} --scenes --set scene.camera_model=OPENCV",
        "cameras with distortion (OPENCV), and F",
    ),
    # Folders that hold data of somebody else.
    ("demo --out users", "users/train is in the way"),
    ("demo --out truth", "truth/test_truth.csv is in the way"),
    ("demo --out x.png", "cannot be written"),
]


@pytest.mark.parametrize(("command", "told"), REFUSALS)
def test_a_command_that_cannot_work_is_refused_in_one_line_before_any_work(
    command, told, demo, small_recipe, clean_environment, tmp_path, monkeypatch, capsys
):
    shutil.copytree(demo.test_dir, "demo/test")
    Path("demo/train").mkdir()
    inputs = (
        "demo/train/scaling_factors.csv",
        "x.png",
        "w/m.pth",
        "users/train/a.csv",
        "truth/test_truth.csv",
    )
    # No command may write over any of them, also through a symbolic or a hard link.
    for name in inputs:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text("precious")
    Path("link.csv").symlink_to("demo/test/test.csv")
    Path("hard.csv").hardlink_to("demo/test/test.csv")

    def too_late(*_: object, **__: object) -> None:
        pytest.fail("rendered before it was refused")

    monkeypatch.setattr(write, "build_world", too_late)
    before = contents(tmp_path)
    assert main(command.split()) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert line.startswith("error: ")
    assert told in line
    # A refused submission may leave a whole file of fallbacks, and nothing else.
    left = contents(tmp_path)
    assert before.items() <= left.items()
    assert left.keys() - before.keys() <= {"submission.csv"}
