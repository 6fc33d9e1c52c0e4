"""``validate.ipynb`` from a clean kernel without network, on the demo set."""

import os
import sys
from pathlib import Path

import nbformat
from kaggle_image import environment
from offline_notebook import execute, needs_namespaces, pictures, printed

ROOT = Path(__file__).resolve().parents[2]
PATHS = os.pathsep.join([str(ROOT), str(ROOT / "notebooks")])  # Jupyter starts a kernel beside its notebook
SETTINGS = {'"classical:whole-images", "classical"': '"small.toml:stage-1", "small.toml"'}
SMALL = """
units = [{ stage = 1, matcher = "sift", long_side = 320 }, { stage = 2, matcher = "sift", long_side = 400 }]
"""


def run(directory: Path, settings: dict[str, str], **variables: str) -> tuple[str, int]:
    """Edit the notebook's settings as a user would and execute it; what it printed, how many pictures it has."""
    (directory / "small.toml").write_text(SMALL, encoding="utf-8")
    notebook = nbformat.read(ROOT / "notebooks" / "validate.ipynb", as_version=4)
    (cell,) = (cell for cell in notebook.cells if cell.id == "settings")
    for former, new in settings.items():
        assert cell.source.count(former) == 1, former
        cell.source = cell.source.replace(former, new)
    nbformat.write(notebook, directory / "validate.ipynb")
    known = {name: value for name, value in environment().items() if name != "MKPC_TRAIN_DIR"}
    known |= {"PYTHONPATH": PATHS, "TMPDIR": str(directory), **variables}
    executed = execute(
        directory / "validate.ipynb", directory / "executed.ipynb", sys.executable, directory, known
    )
    return printed(executed), pictures(executed)


@needs_namespaces
def test_without_a_train_side_recipes_are_compared_on_the_demo_set(tmp_path):
    settings = {"SCENES = []": 'SCENES = ["courtyard"]', "PAIRS_PER_SCENE = 12": "PAIRS_PER_SCENE = 4"}
    text, figures = run(tmp_path, SETTINGS | settings)
    assert "courtyard              4 pairs" in text
    assert "small against small (stage-1): gain of mAA, 95% interval" in text
    assert text.count("mean over scenes         4") == 3
    assert text.count(": covisibility 0.") == 3
    assert figures == 3 + 3, "scores, gains, errors; the hardest pairs"
