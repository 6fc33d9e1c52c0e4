"""``mkpc_tour.ipynb``: it runs on any train side without a network, and is committed with its pictures alone."""

import os
import sys
from pathlib import Path

import nbformat
from kaggle_image import environment
from offline_notebook import execute, needs_namespaces, outputs, pictures, printed, with_pictures_alone

ROOT = Path(__file__).resolve().parents[2]
TOUR = ROOT / "notebooks" / "mkpc_tour.ipynb"
PATHS = os.pathsep.join([str(ROOT), str(TOUR.parent)])  # Jupyter starts a kernel beside its notebook
MIN_BYTES, MAX_BYTES = 500_000, 1_500_000


def figures_of(notebook: nbformat.NotebookNode) -> int:
    """How many figures its cells ask for."""
    return sum(cell.source.count("show(figures.") for cell in notebook.cells if cell.cell_type == "code")


@needs_namespaces
def test_the_tour_runs_on_a_train_side_without_a_network(demo, tmp_path):
    variables = environment(
        PYTHONPATH=PATHS,
        MKPC_TRAIN_DIR=str(demo.train_dir),
        MKPC_PAIR="courtyard;courtyard_0006-courtyard_0001",
        MKPC_OTHER_PAIR="courtyard;courtyard_0003-courtyard_0000",
    )
    executed = execute(TOUR, tmp_path / "executed.ipynb", sys.executable, tmp_path, variables)
    assert pictures(executed) == figures_of(executed) == 16
    assert printed(executed) == ""


def test_the_tour_is_committed_with_all_its_pictures_and_nothing_else():
    tour = nbformat.read(TOUR, as_version=4)
    assert with_pictures_alone(tour) == tour
    assert pictures(tour) == figures_of(tour) == len(outputs(tour))
    assert MIN_BYTES < TOUR.stat().st_size < MAX_BYTES
