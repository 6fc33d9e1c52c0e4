"""``mkpc_tour.ipynb`` and ``validate.ipynb`` from a clean kernel without a network, on the demo set."""

import os
import re
import sys
from pathlib import Path

import nbformat
from kaggle_image import environment
from offline_notebook import (
    execute,
    needs_namespaces,
    outputs,
    pictures,
    printed,
    with_pictures_alone,
)
from shared import write_recipe

ROOT = Path(__file__).resolve().parents[2]
TOUR = ROOT / "notebooks" / "mkpc_tour.ipynb"
# Jupyter starts a kernel in the folder of its notebook
PATHS = os.pathsep.join([str(ROOT), str(TOUR.parent)])
SETTINGS = {  # as a user would edit them
    '"classical:whole-images", "classical"': '"small.toml:stage-1", "small.toml"',
    "SCENES = []": 'SCENES = ["courtyard"]',
    "PAIRS_PER_SCENE = 12": "PAIRS_PER_SCENE = 4",
}


def figures_of(notebook: nbformat.NotebookNode) -> int:
    code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    return sum(len(re.findall(r"show\(\s*figures\.", source)) for source in code)


@needs_namespaces
def test_the_tour_runs_on_a_train_side_without_a_network(demo, tmp_path):
    # Two small units: the figures are the same in number.
    more = "[scene]"
    recipe = write_recipe(tmp_path / "tour.toml", (1, 480), (2, 640), more=more)
    variables = environment(
        MKPC_RECIPE=str(recipe),
        PYTHONPATH=PATHS,
        MKPC_TRAIN_DIR=str(demo.train_dir),
        MKPC_PAIR="courtyard;courtyard_0006-courtyard_0001",
        MKPC_HELPED_PAIR="courtyard;courtyard_0004-courtyard_0001",
        MKPC_OTHER_PAIR="courtyard;courtyard_0003-courtyard_0000",
    )
    executed = execute(TOUR, tmp_path / "executed.ipynb", sys.executable, tmp_path, variables)
    assert pictures(executed) == figures_of(executed) == 18
    # Of small views, a stage may have too few matches.
    warned = [line for line in printed(executed).splitlines() if "Warning: " in line]
    assert [line for line in warned if "no F was found" not in line] == []


def test_the_tour_is_committed_with_all_its_pictures_and_nothing_else():
    tour = nbformat.read(TOUR, as_version=4)
    assert with_pictures_alone(tour) == tour
    assert pictures(tour) == figures_of(tour) == len(outputs(tour))
    # Readers see the pictures without running it, and a clone stays small.
    assert 500_000 < TOUR.stat().st_size < 1_500_000


@needs_namespaces
def test_without_a_train_side_recipes_are_compared_on_the_demo_set(small_recipe, tmp_path):
    """The recipe is ``small.toml`` in the notebook's folder."""
    notebook = nbformat.read(ROOT / "notebooks" / "validate.ipynb", as_version=4)
    (cell,) = (cell for cell in notebook.cells if cell.id == "settings")
    for former, new in SETTINGS.items():
        assert cell.source.count(former) == 1, former
        cell.source = cell.source.replace(former, new)
    path = tmp_path / "validate.ipynb"
    nbformat.write(notebook, path)
    # The demo set must come from the notebook itself.
    known = {name: value for name, value in environment().items() if name != "MKPC_TRAIN_DIR"}
    known |= {"PYTHONPATH": PATHS, "TMPDIR": str(tmp_path)}
    executed = execute(path, tmp_path / "executed.ipynb", sys.executable, tmp_path, known)
    text = printed(executed)
    assert "courtyard              4 pairs" in text
    assert "small against small (stage-1): gain of mAA, 95% interval" in text
    assert len(re.findall("mean over scenes +4 ", text)) == 3
    assert "On these 4 pairs, small " in text
    assert text.count(": covisibility 0.") == 3
    assert pictures(executed) == 3 + 3, "scores, gains, errors; the hardest pairs"
