"""Each of the paper's matchers from a checkpoint in the public file's format to submission.csv.

The weights are stand-ins: what is matched has no worth, but it is matched by all of the real code.
"""

import csv
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from checkpoints import FILES, use_manifest, write_checkpoints
from shared import DATA, needs_data
from standin import scene, use_narrow

from mkpc_kaggle.cli import main
from mkpc_kaggle.data.competition import read_submission, read_test_side, submission_problems
from mkpc_kaggle.engine.journal_tables import JournalReader
from mkpc_kaggle.geometry.coordinates import View
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, Picture
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
from mkpc_kaggle.recipe import load_recipe
from mkpc_kaggle.weights import WeightFile

COLUMNS = ("sample_id", "batch_id", "image_1_id", "image_2_id")


@dataclass(frozen=True)
class Trial:
    """``sizes``: what the units of stage 1 and of stage 2 look at; none fits the networks' multiples.

    ``options`` of the matcher, and ``easy`` ones besides: stand-in weights hardly find pictures alike unless one
    is a piece of the other.
    """

    sizes: tuple[str, str]
    easy: str = ""
    options: str = ""


SEMI_DENSE = Trial(("long_side = 209", "long_side = 150"), easy="threshold = 0.0")
TRIALS = {
    "superglue": Trial(("long_side = 209", "long_side = 190"), easy="match_threshold = 0.01"),
    "loftr": SEMI_DENSE,
    "quadtree": SEMI_DENSE,
    "aspanformer": SEMI_DENSE,
    "loma": Trial(
        ("long_side = 209", "long_side = 150"),
        options='variant = "b128"\nmax_keypoints = 300\nmatch_threshold = 0.0',
    ),
    "dkm": Trial(('area = "96x128"', 'area = "70x90"'), options="matches = 300"),
    "roma": Trial(('area = "96x128"', 'area = "70x90"'), options="matches = 300"),
}


class Checkpoints:
    """A directory of stand-in checkpoints, each written when it is first wanted."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._lines: dict[str, tuple[WeightFile, ...]] = {}

    def of(self, matcher: str) -> tuple[WeightFile, ...]:
        if matcher not in self._lines:
            files = [file for file in FILES if file.matcher == matcher]
            self._lines[matcher] = write_checkpoints(self.directory, files)
        return self._lines[matcher]


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Checkpoints:
    return Checkpoints(tmp_path_factory.mktemp("weights"))


@pytest.fixture(scope="module")
def made_side(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Odd sizes, landscape and portrait, one picture without texture, one of 33 x 47 pixels."""
    directory = tmp_path_factory.mktemp("made")
    whole = scene(240, 240, channels=3)
    pictures = {
        "landscape": whole[64:203, 16:225],
        "portrait": whole[16:225, 40:179],
        "small": whole[120:167, 80:113],
        "blank": np.zeros((131, 175, 3), np.uint8),
    }
    for name, pixels in pictures.items():
        path = directory / "test_images" / "made" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), pixels)
    pairs = [("landscape", "portrait"), ("small", "landscape"), ("portrait", "blank")]
    write_pairs(directory, [(f"made;{first}-{second}", "made", first, second) for first, second in pairs])
    return directory


@pytest.fixture(scope="module")
def real_side(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first pair of some batches of the shared test side."""
    directory = tmp_path_factory.mktemp("real")
    with (DATA / "test" / "test.csv").open(encoding="utf-8") as file:
        rows = [tuple(row[column] for column in COLUMNS) for row in csv.DictReader(file)]
    first = {row[1]: row for row in reversed(rows)}
    chosen = list(first.values())[:2]
    for _, batch, *_ in chosen:
        shutil.copytree(DATA / "test" / "test_images" / batch, directory / "test_images" / batch)
    write_pairs(directory, chosen)
    return directory


def write_pairs(directory: Path, rows: Sequence[tuple[str, ...]]) -> None:
    with (directory / "test.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])


def write_recipe(directory: Path, matcher: str, *, easy: bool, tables: str = "") -> Path:
    path, trial = directory / "small.toml", TRIALS[matcher]
    units = [f'{{ stage = {n}, matcher = "{matcher}", {size} }}' for n, size in enumerate(trial.sizes, start=1)]
    options = [f"[matchers.{matcher}]", trial.options, trial.easy if easy else "", tables]
    path.write_text("\n".join([f"units = [{', '.join(units)}]", *options]), encoding="utf-8")
    return path


def make_submission(*arguments: object) -> None:
    """In this process, so that it meets the manifest that was put in its way."""
    assert main(["submit", *map(str, arguments)]) == 0


def matches_found(work_dir: Path) -> dict[tuple[int, int], int]:
    """The matches of each pair's unit by (pair, stage); none of the units may have failed."""
    with JournalReader(work_dir) as journal:
        found = [(index, unit) for index, record in journal.records().items() for unit in record.units]
    assert [unit.failure for _, unit in found] == [""] * len(found)
    return {(index, unit.stage): unit.matches for index, unit in found}


def assert_good(output: Path, test_dir: Path) -> None:
    ids = [pair.id for pair in read_test_side(test_dir)]
    assert submission_problems(output, ids) == []
    for F in read_submission(output).values():
        strengths = np.linalg.svd(F, compute_uv=False)
        assert strengths[2] < 1e-6 * strengths[0] < 1e6 * strengths[1]


@dataclass(frozen=True)
class Made:
    """A submission, and how many matches its units found by (pair, stage)."""

    output: Path
    matches: dict[tuple[int, int], int]


@pytest.fixture
def run(
    clean_environment: None, checkpoints: Checkpoints, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[..., Made]:
    """A function that makes a submission of a test side with one of the matchers."""

    def made(
        matcher: str,
        test_dir: Path,
        name: str = "submission",
        *,
        easy: bool = False,
        tables: str = "",
        workers: int = 0,
    ) -> Made:
        use_manifest(monkeypatch, checkpoints.of(matcher))
        use_narrow(monkeypatch)
        output, recipe = tmp_path / f"{name}.csv", write_recipe(tmp_path, matcher, easy=easy, tables=tables)
        make_submission(
            *("--test-dir", test_dir, "--output", output, "--recipe", recipe),
            *("--weights", checkpoints.directory, "--time-limit", "10m", "--device", "cpu"),
            *("--no-report", "--workers", workers),
        )
        assert_good(output, test_dir)
        return Made(output, matches_found(tmp_path / f"{name}.work"))

    return made


@pytest.mark.parametrize("matcher", TRIALS)
def test_odd_small_and_blank_pictures_go_through(run: Callable[..., Made], matcher: str, made_side: Path) -> None:
    processes = matcher != "roma"  # other processes know no narrow network
    made = run(matcher, made_side, workers=int(processes))
    assert made.matches.keys() == {(pair, stage) for pair in range(3) for stage in (1, 2)}
    assert made.matches[0, 1] >= 8
    if matcher not in {"dkm", "roma", "loma"}:  # which have answers for all pixels, and keypoints on any picture
        assert made.matches[2, 1] == made.matches[2, 2] == 0
    assert run(matcher, made_side, "again").output.read_bytes() == made.output.read_bytes()


@needs_data
@pytest.mark.parametrize("matcher", TRIALS)
def test_real_pictures_go_through(run: Callable[..., Made], matcher: str, real_side: Path) -> None:
    made = run(matcher, real_side, easy=True)
    assert len(made.matches) == 4
    assert min(made.matches.values()) > 0


@pytest.mark.parametrize("matcher", ["loma", "roma"])
def test_a_batch_is_reconstructed_from_their_matches(
    run: Callable[..., Made], matcher: str, made_side: Path
) -> None:
    """All it can come to is a reason: the pictures are pieces of one, which no two cameras have seen."""
    made = run(matcher, made_side, easy=True, tables="[focal]\n[scene]\npairs_per_image = 0")
    work_dir = made.output.with_suffix(".work")
    with JournalReader(work_dir) as journal:
        (scene,) = journal.scenes()
        choices = [journal.records()[pair].scene for pair in range(3)]
    assert scene.images >= 3  # the blank picture has no keypoints
    assert scene.failure or scene.placed
    assert scene.seconds > 0
    assert None not in choices


class Clump:
    """Sees the same 33 x 47 pixels matched in every pair, so that stage 2 looks at no more than those."""

    spec = MatcherSpec("clump", "for tests")
    corner = np.array([90, 61])

    def encode(self, pictures: Sequence[Picture]) -> list[View]:
        return [picture.view for picture in pictures]

    def match(self, encodings0: Sequence[View], encodings1: Sequence[View]) -> list[Matches]:
        points = np.stack(np.meshgrid(np.arange(0, 33, 4), np.arange(0, 47, 2)), axis=-1).reshape(-1, 2)
        points = points + self.corner
        return [
            Matches(first.from_image(points), second.from_image(points), np.ones(len(points)))
            for first, second in zip(encodings0, encodings1, strict=True)
        ]


@pytest.mark.parametrize("size", ["long_side = 47", ""])
@pytest.mark.parametrize("matcher", TRIALS)
def test_a_tiny_crop_goes_through(
    clean_environment: None,
    checkpoints: Checkpoints,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    matcher: str,
    size: str,
) -> None:
    """At its own size, and enlarged; points lie on the crop, whatever it was padded to."""
    use_manifest(monkeypatch, checkpoints.of(matcher))
    use_narrow(monkeypatch)
    path = tmp_path / "crop.toml"
    path.write_text(
        'units = [{ stage = 1, matcher = "clump", long_side = 300 },'
        f'{{ stage = 2, matcher = "{matcher}", {size or TRIALS[matcher].sizes[1]} }}]\n[mkpc]\nexpand_x = 1.0\n'
        f"[matchers.{matcher}]\n{TRIALS[matcher].options}"
    )
    match = TwoStageMatcher(
        load_recipe(str(path)), weights=[checkpoints.directory], device="cpu", matchers={"clump": Clump()}
    )
    picture = scene(207, 313, channels=3)
    found = match(picture, picture)
    assert found.regions is not None
    assert [region.box.size for region in found.regions] == [(33, 47)] * 2
    _, result = found.results
    assert result.failure == ""
    assert size or len(result.matches) > 0
    for region, points in zip(found.regions, (result.matches.points0, result.matches.points1), strict=True):
        assert region.box.contains(points).all()
