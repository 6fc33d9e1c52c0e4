"""``submission.ipynb`` as Kaggle runs it: the dataset folder, an image without our package, and no network."""

import re
import tomllib
from pathlib import Path

import nbformat
import pytest
from genuine import GENUINE, why_not_there
from kaggle_image import environment, make_image, python_version, upload
from offline_notebook import execute, needs_namespaces, pictures, printed
from packaging.requirements import Requirement
from shared import DATA, WEIGHTS, problem_of

from mkpc_kaggle.package import COMPETITION, PYTHONS, make_package

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "notebooks").glob("*.ipynb"))


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_image(tmp_path_factory.mktemp("image"))


pytestmark = pytest.mark.usefixtures("built_once")


class Kaggle:
    """A copy of Kaggle's directories: ``input`` with the competition and our dataset, and
    ``working``.
    """

    def __init__(self, root: Path, image: Path, wheels: Path) -> None:
        self.root = root
        self.image = image
        self._wheels = wheels
        self.working = root / "working"
        self.test_dir = root / "input" / "competitions" / COMPETITION
        self.dataset = root / "input" / "datasets" / "someone" / "mkpc-kaggle"
        self.executed = root / "executed.ipynb"
        self.working.mkdir(parents=True)

    def add_test_side(self, test_dir: Path, pairs: int | None = None) -> None:
        self.test_dir.mkdir(parents=True)
        lines = (test_dir / "test.csv").read_text(encoding="utf-8").splitlines()
        rows = len(lines) if pairs is None else pairs + 1
        (self.test_dir / "test.csv").write_text("\n".join(lines[:rows]), encoding="utf-8")
        (self.test_dir / "test_images").symlink_to(test_dir / "test_images")

    def add_dataset(self, packaged: Path, weights: tuple[Path, ...] = ()) -> None:
        pythons = [python_version()]
        make_package(packaged, "someone", weights, pythons=pythons, wheels=self._wheels)
        upload(packaged / "dataset", self.dataset)
        self.notebook = packaged / "kernel" / "submission.ipynb"

    def run(self, **more: str) -> str:
        """Execute the notebook; return the printed text. AssertionError if a cell fails."""
        variables = environment(KAGGLE_ROOT=str(self.root), **more)
        return printed(
            execute(self.notebook, self.executed, self.image, self.working, variables)
        )

    def figures(self) -> int:
        return pictures(nbformat.read(self.executed, as_version=4))

    def pages(self) -> str:
        cells = nbformat.read(self.executed, as_version=4).cells
        shown = [output for cell in cells for output in cell.get("outputs", [])]
        return "".join(output.get("data", {}).get("text/html", "") for output in shown)

    def problem(self) -> str:
        return problem_of(self.working / "submission.csv", self.test_dir)


@pytest.fixture
def kaggle(tmp_path: Path, image: Path, wheels: Path) -> Kaggle:
    return Kaggle(tmp_path / "kaggle", image, wheels)


VERSIONS = "opencv-python-headless=={} scikit-learn==1.6.1 scipy==1.15.3 torch=={} numpy=={}"
IMAGES = [  # of Kaggle's: Python, OpenCV, torch, NumPy
    ("3.11", "4.11.0.86", "2.6.0", "1.26.4"),
    ("3.12", "4.13.0.92", "2.11.0", "2.0.2"),
    ("3.13", "5.0.0.93", "2.11.0", "2.1.3"),
]


@pytest.mark.parametrize(("python", "opencv", "torch", "numpy"), IMAGES)
def test_every_kaggle_image_has_the_packages_that_the_dataset_lacks(
    python, opencv, torch, numpy
):
    text = (NOTEBOOKS[0].parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    dependencies = tomllib.loads(text)["project"]["dependencies"]
    taken = {need.name: need for need in map(Requirement, dependencies)}
    # The dataset does not bundle these: a higher floor in pyproject.toml would stop the notebook.
    for pin in VERSIONS.format(opencv, torch, numpy).split():
        name, _, version = pin.partition("==")
        assert version in taken[name].specifier, name
    assert python in PYTHONS


# Output of the run with genuine weights, with stand-ins, and without weights. Each run of the
# notebook takes half a minute, so there is one, with the best available weights.
PRINTED = {
    GENUINE: (
        "2 files, 0 refused, 0 missing",
        "1 of 1 pair with an F",
        r"\n1:xfeat_lighterglue@\d+ +1 +[1-9]",
    ),
    WEIGHTS: (
        "3 files, 0 refused, 0 missing",
        "1:xfeat_lighterglue@1024 ",
        "1:aliked@1024 ",
        "left out, no weights: ",
    ),
    None: ("RootSIFT only; ",),
}


def best_weights() -> Path | None:
    """Return the folder of the best weights: genuine ones are of use on photographs alone."""
    if DATA.is_dir() and not why_not_there():
        return GENUINE
    return WEIGHTS if WEIGHTS.is_dir() else None


def packaged_weights(source: Path | None, directory: Path) -> tuple[Path, ...]:
    if source is not GENUINE:
        return () if source is None else (source,)
    directory.mkdir()
    # The fastest matcher alone: all genuine weights would add units to recipe auto.
    for name in ("xfeat.pt", "xfeat-lighterglue.pt"):
        (directory / name).symlink_to(GENUINE / name)
    return (directory,)


@needs_namespaces
def test_a_saved_version_without_a_network_writes_a_submission_and_shows_pairs(
    kaggle, demo, tmp_path
):
    """On photographs where there are some, else on rendered pictures."""
    kaggle.add_test_side(DATA / "test" if DATA.is_dir() else demo.test_dir, pairs=1)
    source = best_weights()
    kaggle.add_dataset(tmp_path / "package", packaged_weights(source, tmp_path / "weights"))
    # Kaggle's mounts are links, and an older version of the dataset may still be attached.
    mounted = tmp_path / "mounted"
    kaggle.dataset.rename(mounted)
    kaggle.dataset.symlink_to(mounted)
    other = kaggle.root / "input" / "datasets" / "zz" / "older"
    other.mkdir(parents=True)
    older = other / "mkpc_kaggle-0.0.9-py3-none-any.whl"
    older.touch()
    printed = kaggle.run()
    assert f"not used     {older}" in printed
    assert [text for text in PRINTED[source] if not re.search(text, printed)] == [], printed
    assert "runs without" not in printed
    assert kaggle.problem() == ""
    assert "good: 1 row" in printed
    assert "recipe auto" in printed
    assert "of 525 minutes used" in printed
    assert printed.count("sweep: ") <= 2, (
        "a notebook keeps every line, so progress is few of them"
    )
    assert f"report: {kaggle.working / 'submission.html'}" in printed
    assert (kaggle.working / "submission.html").is_file()
    assert (kaggle.root / "temp" / "submission.work" / "journal.sqlite").is_file()
    assert not list(kaggle.working.rglob("journal*")), "files in `working` are published"
    assert kaggle.figures() == 1, "the pair"
    assert "&lt;title&gt;" in kaggle.pages(), "the report, in an iframe"


@needs_namespaces
def test_a_failed_run_fails_the_notebook_but_not_the_hidden_rerun(kaggle, demo, tmp_path):
    kaggle.add_test_side(demo.test_dir, pairs=1)
    (kaggle.test_dir / "test_images").unlink()
    for path in (demo.test_dir / "test_images").rglob("*.png"):
        broken = kaggle.test_dir / path.relative_to(demo.test_dir)
        broken.parent.mkdir(parents=True, exist_ok=True)
        broken.write_bytes(b"no picture")
    kaggle.add_dataset(tmp_path / "package")
    # The public cells once more, after a hidden run: a run of its own would only take longer.
    notebook = nbformat.read(kaggle.notebook, as_version=4)
    public = [
        cell.source for cell in notebook.cells if cell.source.startswith("if not IS_RERUN")
    ]
    assert len(public) == 2
    sources = ["print('public'); IS_RERUN = False", *public]
    notebook.cells += map(nbformat.v4.new_code_cell, sources)
    nbformat.write(notebook, kaggle.notebook)
    # A public run that fails shows its reason before a submission is spent.
    with pytest.raises(AssertionError, match=r"THE RUN FAILED \(exit status 1\)"):
        kaggle.run(KAGGLE_IS_COMPETITION_RERUN="1")
    # The hidden run is the only chance: a file of fallback rows is better than none.
    hidden, _ = printed(nbformat.read(kaggle.executed, as_version=4)).split("public\n")
    assert "THE RUN FAILED" in hidden
    assert "The hidden run continues" in hidden
    assert kaggle.figures() == 0
    assert kaggle.problem() == ""


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_committed_without_traces_of_a_run_except_pictures(path):
    text = path.read_text(encoding="utf-8")
    notebook = nbformat.reads(text, as_version=4)
    nbformat.validate(notebook)
    # Editors write notebooks in many forms; one form keeps differences small.
    assert nbformat.writes(notebook) + "\n" == text
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert code
    shown = [output for cell in code for output in cell.outputs]
    assert all(cell.execution_count is None for cell in code)
    assert not shown or path.stem == "mkpc_tour"
    for each in shown:
        assert each["output_type"] == "display_data"
        assert list(each["data"]) == ["image/jpeg"]
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
