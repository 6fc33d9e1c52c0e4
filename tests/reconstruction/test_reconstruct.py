"""Folders of images in, cameras out: COLMAP's files, tables, several models, images that lie on a
side.
"""

import csv
import hashlib
import shutil
import sqlite3
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pycolmap
import pytest
from exif_files import set_exif
from faulty import befall, scenes_by
from pair_lists import turned_camera
from rectified import Seen, flat, number_of
from shared import run_command
from sklearn.datasets import load_sample_image
from synthetic import QUICK, SyntheticMatcher

from benchmarks.synthetic_scene import SIZE, SyntheticScene, synthetic_scene
from mkpc_kaggle import results
from mkpc_kaggle.data.images import TURNS
from mkpc_kaggle.engine.plan.budget import Budget
from mkpc_kaggle.engine.session import Interrupt, Session
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.dataframes import ELEMENTS
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.engine.workers.worker import compute_scene
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.cameras import fundamental_of_cameras
from mkpc_kaggle.geometry.focal_prior import FocalConfig
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import RobustConfig
from mkpc_kaggle.matchers.adapters.sift import SiftMatcher, SiftOptions
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit
from mkpc_kaggle.reconstruction import choice
from mkpc_kaggle.reconstruction.folder import read_folder, read_pair_list
from mkpc_kaggle.reconstruction.outputs import (
    Cameras,
    PlacedImage,
    camera_rows,
    read_table_of_cameras,
    submission_rows,
    write_tables,
)
from mkpc_kaggle.reconstruction.run import (
    EARLIER,
    FolderResult,
    for_cameras,
    reconstruct_folder,
)
from mkpc_kaggle.scene import likeness
from mkpc_kaggle.scene.likeness import (
    largest_features,
    local_features,
    most_alike,
    overlapping,
    shortlist,
)
from mkpc_kaggle.setup.assembly import assemble

RECIPE = for_cameras(Recipe((Unit(1, "synthetic", SIZE.width),), magsac=QUICK))
# The brightness of a flat image is its number.
FIRST, SECOND, OTHERS = 6, 4, 1  # images of two scenes, and of none


@dataclass
class MixedMatcher(SyntheticMatcher):
    """Two scenes, and images of neither; between what has nothing in common it finds a few wrong
    matches.
    """

    @cached_property
    def scenes(self) -> tuple[SyntheticScene, SyntheticScene]:
        return synthetic_scene(FIRST, points=500), synthetic_scene(SECOND, points=500, seed=7)

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        first = number_of(seen0)
        second = number_of(seen1)
        self.calls.append((first, second))
        # Both in one scene: its matches. Otherwise a few wrong ones, as real matchers find.
        for scene, start, count in ((self.scenes[0], 0, FIRST), (self.scenes[1], FIRST, SECOND)):
            if start <= first < second < start + count:
                names = [f"{first - start:04}", f"{second - start:04}"]
                (found,) = (
                    p.matches for p in scene.pairs if [p.image0.name, p.image1.name] == names
                )
                return found  # views are upright and as large as the images
        return Matches(
            *np.random.default_rng([first, second]).uniform(10, 500, (2, 25, 2)), np.ones(25)
        )


class MatcherOfNothing(MixedMatcher):
    """Finds no match between any two images."""

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        return Matches.empty()


def write_flat(folder: Path, count: int = FIRST + SECOND + OTHERS) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        cv2.imwrite(str(folder / f"{number:02}.png"), flat(number, SIZE))
    return folder


def run(
    root: Path,
    out: Path,
    matcher: SyntheticMatcher | None = None,
    interrupt: Interrupt | None = None,
    recipe: Recipe = RECIPE,
    **options: object,
) -> FolderResult:
    """Reconstruct a folder, with ``cameras.csv`` as the command writes it."""
    matcher = matcher or MixedMatcher()
    options = {"publish": lambda found: write_tables(out, found, root, None)} | options
    budget = Budget(time.monotonic(), float("inf"))
    session = Session(out / "work", budget, interrupt or Interrupt(), progress=False, workers=0)
    assembly = assemble(recipe, matchers={"synthetic": matcher}, device="cpu")
    return reconstruct_folder(root, read_folder(root), assembly, session, out, **options)


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FolderResult]:
    home = tmp_path_factory.mktemp("mixed")
    return home / "out", run(write_flat(home / "images"), home / "out")


def cameras(result: FolderResult) -> Mapping[str, PlacedImage]:
    (found,) = result.cameras.values()
    return {file.name: placed for file, placed in found.items() if placed}


def contents(out: Path) -> dict[str, str]:
    """What a run left, but for its journal; of a database its rows, since SQLite counts who has
    opened it.
    """
    found = {}
    for path in sorted(out.rglob("*")):
        if path.suffix == ".db":
            with closing(sqlite3.connect(path)) as database:
                found[str(path.relative_to(out))] = "".join(database.iterdump())
        elif path.is_file() and "work" not in path.parts:
            found[str(path.relative_to(out))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def test_mixed_scenes_are_a_model_each_and_foreign_images_are_in_none(mixed):
    out, result = mixed
    models = [pycolmap.Reconstruction(out / "models" / str(number)) for number in range(2)]
    names = [
        sorted(image.name for image in model.images.values() if image.has_pose) for model in models
    ]
    assert names == [[f"{n:02}.png" for n in range(6)], [f"{n:02}.png" for n in range(6, 10)]]
    # The foreign image has wrong matches with all others.
    assert not (out / "models" / "2").exists()
    assert sorted(cameras(result)) == sorted(names[0] + names[1])
    assert [model.num_points3D() > 100 for model in models] == [True, True]


def test_a_model_that_was_cut_off_is_made_again(tmp_path):
    root = write_flat(tmp_path / "images", FIRST)
    run(root, tmp_path / "out")
    before = contents(tmp_path / "out")
    path = tmp_path / "out" / "models" / "0" / "images.bin"
    path.write_bytes(path.read_bytes()[:500])
    run(root, tmp_path / "out")
    assert contents(tmp_path / "out") == before


def test_the_cameras_are_those_of_the_models_and_right(mixed):
    out, result = mixed
    truth = MixedMatcher().scenes[0].cameras
    model = pycolmap.Reconstruction(out / "models" / "0")
    rows = {row[0]: row for row in camera_rows(result.cameras, out.parent / "images")}
    for image in model.images.values():
        K, R, t, points = (
            np.array([float(x) for x in cell.split(";")]) for cell in rows[image.name][2:6]
        )
        np.testing.assert_allclose(
            R.reshape(3, 3), image.cam_from_world().matrix()[:, :3], atol=1e-9
        )
        np.testing.assert_allclose(t, image.cam_from_world().matrix()[:, 3], atol=1e-9)
        np.testing.assert_allclose(
            K.reshape(3, 3)[:2, 2] + 0.5, image.camera.calibration_matrix()[:2, 2]
        )
        assert K[0] == pytest.approx(truth["00" + image.name[:2]].K[0, 0], rel=0.03)
        assert points == image.num_points3D


@pytest.mark.parametrize(
    ("name", "more", "units"),
    [
        ("auto", {}, ["1:sift@1536"]),
        ("classical", {}, ["1:sift@1536", "2:sift@1440", "1:sift@1280"]),
        ("auto", {"loma": SiftMatcher(SiftOptions(), "cpu")}, None),
    ],
)
def test_without_weights_one_unit_of_rootsift_runs_and_enlarges_no_image(
    nowhere_else, name, more, units
):
    """A recipe that the user names, and one with other matchers, runs as it is written."""
    recipe = assemble(name, device="cpu", matchers=more).recipe
    changed = for_cameras(recipe)
    kept = changed.units
    assert [unit.name for unit in kept] == (units or [unit.name for unit in recipe.units])
    assert all(unit.enlarge for unit in kept) == (len(kept) > 1)
    # A larger folder starts from fewer tracks by recipe auto alone, with any matchers.
    assert (changed.scene.all_tracks < SceneConfig().all_tracks) == (name == "auto")


def test_estimates_that_only_the_report_needs_are_the_cheap_ones():
    recipe = Recipe((Unit(1, "sift", 640),), focal=FocalConfig(), magsac=RobustConfig())
    assert recipe.magsac.permutations > 1
    kept = for_cameras(recipe)
    assert (kept.focal, kept.magsac.permutations) == (None, 1)
    assert kept.magsac.max_iterations < recipe.magsac.max_iterations
    # A recipe with fewer keeps its own.
    few = replace(recipe, magsac=RobustConfig(max_iterations=100))
    assert for_cameras(few).magsac.max_iterations == 100


def pairs_of(out: Path) -> pd.DataFrame:
    """The table of pairs, by the names of the images, without seconds."""
    pairs = results(out / "work").pairs
    kept = [name for name in pairs if not name.endswith("_seconds")]
    return pairs[kept].set_index(["image0", "image1"])


def test_a_pair_with_two_cameras_takes_f_from_them(mixed):
    out, result = mixed
    pairs = pairs_of(out)
    is_seen = pairs["source"] == "scene"
    # Both scenes, and no image of the other one or of none
    assert is_seen.sum() == FIRST * (FIRST - 1) / 2 + SECOND * (SECOND - 1) / 2
    assert pairs["overlaps"][is_seen].all()
    for names in pairs.index[is_seen]:
        F = fundamental_of_cameras(*(cameras(result)[name].camera for name in names))
        np.testing.assert_allclose(pairs.loc[names][ELEMENTS].astype(float), F.ravel(), atol=1e-12)
        assert pairs.loc[names, "inliers"] > 20


def test_results_are_the_same_wherever_a_run_is_cut(tmp_path, monkeypatch):
    root = write_flat(tmp_path / "images", 5)
    run(root, tmp_path / "undisturbed")
    expected = pairs_of(tmp_path / "undisturbed")
    puts = []
    put = Store.put
    monkeypatch.setattr(Store, "put", lambda store, rows: puts.append(put(store, rows)))
    for limit in range(4, 24, 4):
        out = tmp_path / f"cut after {limit}"
        puts.clear()
        run(root, out, interrupt=After(puts, limit))
        run(root, out)
        pd.testing.assert_frame_equal(pairs_of(out), expected)
        assert contents(out) == contents(tmp_path / "undisturbed")


class After(Interrupt):
    """An interrupt that is set once a list has so many elements."""

    def __init__(self, elements: list[None], limit: int) -> None:
        super().__init__()
        self.elements = elements
        self.limit = limit

    def is_set(self) -> bool:
        return len(self.elements) >= self.limit


def test_without_cameras_every_pair_is_estimated_by_itself(tmp_path, monkeypatch):
    root = write_flat(tmp_path / "images", 4)
    with monkeypatch.context() as patched:
        scenes_by(patched, partial(befall, fail))
        run(root, tmp_path / "out")
    alone = pairs_of(tmp_path / "out")
    assert alone["source"].tolist() == ["pair"] * 6
    assert alone["inliers"].min() > 20
    # The next run has cameras.
    run(root, tmp_path / "out")
    assert set(pairs_of(tmp_path / "out")["source"]) == {"scene"}


# Upright, on both sides, and upside down
ORIENTATIONS = (1, 6, 8, 3, 6, 1)  # of the images of a phone, by EXIF


def test_colmap_goes_on_with_photographs_that_exif_turns(tmp_path):
    root = write_flat(tmp_path / "images", FIRST)
    out = tmp_path / "out"
    for number, orientation in enumerate(ORIENTATIONS):
        path = root / f"{number:02}.png"
        cv2.imwrite(str(path), np.rot90(flat(number, SIZE), -TURNS.get(orientation, 0)))
        set_exif(path, orientation)
    result = run(root, out)
    sizes = {f"{n:02}.png": SIZE if o in (1, 3) else SIZE[::-1] for n, o in enumerate(ORIENTATIONS)}
    (model,) = result.report.scenes[0].models
    assert {image.image.name: image.image.size for image in model.images} == sizes
    # COLMAP's own mapper, from our database and the user's photographs
    settings = {"min_model_size": 3, "random_seed": 0, "extract_colors": True, "num_threads": 1}
    options = pycolmap.IncrementalPipelineOptions(settings)
    (model,) = pycolmap.incremental_mapping(out / "database.db", root, tmp_path, options).values()
    assert model.num_reg_images() == FIRST
    pycolmap.undistort_images(tmp_path / "flat", out / "models" / "0", root)
    for name, size in sizes.items():
        picture = cv2.imread(
            str(tmp_path / "flat" / "images" / name), cv2.IMREAD_IGNORE_ORIENTATION
        )
        assert picture.shape[1::-1] == size
    flattened = pycolmap.Reconstruction(tmp_path / "flat" / "sparse")
    # Sizes by EXIF's orientation would be exchanged.
    undistorted = {
        image.name: (image.camera.width, image.camera.height) for image in flattened.images.values()
    }
    assert undistorted == sizes
    truth = MixedMatcher().scenes[0].cameras
    for number, record in enumerate(cameras(result).values()):
        stored = turned_camera(truth[f"{number:04}"], -TURNS.get(ORIENTATIONS[number], 0), SIZE)
        expected = stored.R @ truth["0000"].R.T
        np.testing.assert_allclose(
            record.camera.R @ cameras(result)["00.png"].camera.R.T, expected, atol=0.01
        )


def test_results_that_were_removed_are_made_again_and_an_image_that_was_absent_comes_back(tmp_path):
    root = write_flat(tmp_path / "images", 4)
    out = tmp_path / "out"
    run(root, out)
    before = contents(out)
    # The store still has the scene, but its files are gone.
    for removed in ("models/0/points3D.bin", "database.db"):
        (out / removed).unlink()
        matcher = MixedMatcher()
        run(root, out, matcher)
        assert (contents(out), matcher.calls) == (before, [])
    (root / "03.png").rename(tmp_path / "away.png")
    run(root, out)
    (tmp_path / "away.png").rename(root / "03.png")
    run(root, out)
    assert contents(out) == before


def grow(root: Path) -> Recipe:
    write_flat(root, 5)
    return RECIPE


def replace_an_image(root: Path) -> Recipe:
    cv2.imwrite(str(root / "03.png"), flat(4, SIZE))
    return RECIPE


# What changes after a run, and the number of cameras of the next complete one
CHANGES_OF_A_FOLDER = {
    "a new image": (grow, 5),
    "a replaced image": (replace_an_image, 4),
    "another setting": (
        lambda _: replace(RECIPE, magsac=replace(RECIPE.magsac, threshold=1.0)),
        4,
    ),
    "another matcher": (
        lambda _: replace(RECIPE, units=(Unit(1, "synthetic", SIZE.width, max_matches=900),)),
        4,
    ),
}


@pytest.mark.parametrize(("change", "count"), CHANGES_OF_A_FOLDER.values(), ids=CHANGES_OF_A_FOLDER)
def test_files_of_an_earlier_run_stay_until_a_run_has_cameras(tmp_path, monkeypatch, change, count):
    root = write_flat(tmp_path / "images", 4)
    out = tmp_path / "out"
    run(root, out)
    before = contents(out)
    recipe = change(root)
    # The first loss may leave files of either scene, and the next run begins from these.
    with monkeypatch.context() as patched:
        scenes_by(patched, partial(befall, fail))
        for _ in range(2):
            result = run(root, out, recipe=recipe)
            assert contents(out) == before
            assert result.earlier == ["."]
            assert f"images: {EARLIER}" in result.report.faults
    interrupt = Interrupt()
    interrupt.set()
    assert run(root, out, interrupt=interrupt, recipe=recipe).earlier == ["."]
    assert contents(out) == before
    result = run(root, out, recipe=recipe)
    assert (len(cameras(result)), result.earlier) == (count, [])
    assert contents(out).keys() == before.keys()


def test_each_dataset_has_its_new_cameras_or_those_of_an_earlier_run(tmp_path, monkeypatch):
    root = tmp_path / "images"
    for name in ("a", "b"):
        write_flat(root / name, 4)
    out = tmp_path / "out"
    run(root, out)
    before = (out / "cameras.csv").read_text().splitlines()
    shutil.copy(root / "a" / "00.png", root / "a" / "copy.png")
    write_flat(root / "b", 5)

    def fail_one(job):
        return befall(fail, job) if job.batch == "b" else compute_scene(job)

    with monkeypatch.context() as patched:
        scenes_by(patched, fail_one)
        result = run(root, out)
    assert result.earlier == ["b"]
    after = (out / "cameras.csv").read_text().splitlines()
    assert len(after) == len(before) + 1, "the copy"
    assert [row for row in after if row.startswith("b/")] == before[5:]


def test_files_of_an_earlier_run_are_removed_once_no_image_has_a_match(tmp_path, capsys):
    root = write_flat(tmp_path / "images", 4)
    out = tmp_path / "out"
    run(root, out)
    for number, file in enumerate(sorted(root.iterdir())):
        cv2.imwrite(str(file), flat(FIRST + number, SIZE))
    result = run(root, out, MatcherOfNothing())
    assert (result.earlier, cameras(result)) == ([], {})
    assert "the models of an earlier run were removed" in capsys.readouterr().err
    assert not any((out / name).exists() for name in ("models", "database.db", "sparse"))
    assert len((out / "cameras.csv").read_text().splitlines()) == 1


ROW = "a.png,0,1;0;0;0;1;0;0;0;1,1;0;0;0;1;0;0;0;1,0;0;0,,,,,\n"
DAMAGED_TABLES = [
    "",
    "image,model\n",
    ROW,
    "{heads}\na.png,0\n",
    "{heads}\na.png," + 9 * "x,",
    "{heads}\n" + ROW.replace("0;0;0,,", "0;0;inf,,"),
    "{heads}\n" + ROW.replace("0;0;0,,", "0;0,,"),
    "\0" * 80,
    "{heads}\n\0\0",
    "{heads}\n\udcff\n",  # not UTF-8
]


@pytest.mark.parametrize("text", DAMAGED_TABLES)
def test_a_table_of_cameras_that_cannot_be_read_is_replaced_with_a_warning(tmp_path, capsys, text):
    path = tmp_path / "cameras.csv"
    files = {".": (tmp_path / "a.png",)}
    text = text.format(heads=",".join(next(camera_rows({}, tmp_path))))
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    assert read_table_of_cameras(path, tmp_path, files) == {".": {tmp_path / "a.png": None}}
    assert "cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize("end", ["\n", "\n\n"], ids=["as written", "with blank lines"])
def test_a_table_of_cameras_is_read_as_it_was_written(mixed, tmp_path, end):
    out, result = mixed
    root = out.parent / "images"
    path = tmp_path / "cameras.csv"
    path.write_text((out / "cameras.csv").read_text().replace("\n", end))
    read = read_table_of_cameras(path, root, read_folder(root))
    assert [*camera_rows(read, root)] == [*camera_rows(result.cameras, root)]


def fail():
    raise OSError(28, "No space left on device")


def test_a_folder_in_the_folder_is_a_dataset_and_files_of_one_content_share_a_camera(tmp_path):
    write_flat(tmp_path / "images" / "a", 5)
    # The same content under another name
    (tmp_path / "images" / "a" / "copy.png").write_bytes(
        (tmp_path / "images" / "a" / "00.png").read_bytes()
    )
    write_flat(tmp_path / "images" / "b", 1)
    (tmp_path / "images" / "a" / "broken.jpg").write_bytes(b"no picture")
    (tmp_path / "images" / "notes.txt").write_text("not an image")
    result = run(tmp_path / "images", tmp_path / "out")
    assert (tmp_path / "out" / "a" / "models" / "0").is_dir()
    _, *rows = submission_rows("imc2025", result.cameras, tmp_path / "images")
    assert [(row[0], row[1], row[2], row[3]) for row in rows] == [
        *((f"a_{n:02}.png", "a", "cluster0", f"{n:02}.png") for n in range(5)),
        ("a_broken.jpg", "a", "outliers", "broken.jpg"),
        ("a_copy.png", "a", "cluster0", "copy.png"),
        ("b_00.png", "b", "outliers", "00.png"),
    ]
    # The copy has the camera of its original.
    assert rows[0][4:] == rows[6][4:]
    assert rows[-1][4:] == (";".join(["nan"] * 9), "nan;nan;nan")
    earlier = {
        row[0]: row for row in submission_rows("imc2023", result.cameras, tmp_path / "images")
    }
    assert earlier["a/00.png"][1:3] == ("a", "a")
    assert earlier["b/00.png"][3:] == ("1;0;0;0;1;0;0;0;1", "0;0;0")


def test_only_listed_pairs_are_matched(tmp_path):
    root = write_flat(tmp_path / "images" / "set", 4).parent
    # In the other order, and with blank lines between
    wanted = list(combinations(range(4), 2))[:5]
    (tmp_path / "pairs.txt").write_text(
        "".join(f"set/{j:02}.png set/{i:02}.png\n\n" for i, j in wanted)
    )
    matcher = MixedMatcher()
    listed = read_pair_list(tmp_path / "pairs.txt", root, read_folder(root))
    run(root, tmp_path / "out", matcher, listed=listed)
    assert sorted(matcher.calls) == wanted
    for line in ("set/00.png", "set/00.png set/00.png", "set/00.png set/09.png", "x y z", ""):
        (tmp_path / "pairs.txt").write_text(line)
        with pytest.raises(
            UserError, match=r"expected two images of one dataset" if line else "has no pairs"
        ):
            read_pair_list(tmp_path / "pairs.txt", root, read_folder(root))


def test_folders_that_cannot_be_reconstructed_get_one_line(tmp_path, capsys):
    root = tmp_path / "images"
    out = tmp_path / "out"

    def refused(out: Path = out) -> str:
        assert run_command("reconstruct", root, "--out", out, "--recipe", "classical") == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    assert "no such directory" in refused()
    root.mkdir()
    assert "has no images" in refused()
    (root / "a.png").write_bytes(b"")
    assert "has a single image, a.png: matching needs two" in refused()
    (root / "a.jpg").write_bytes(b"")
    assert "has both a.jpg and a.png; rename one of them" in refused()
    (root / "a.jpg").rename(root / "b.jpg")
    assert "contains, or lies in, the input" in refused(root / "out")
    assert not out.exists()


def test_a_folder_without_a_readable_image_says_so_and_fails(tmp_path, capsys):
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(b"")
    options = ["--out", f"{tmp_path}-out", "--recipe", "classical", "--workers", 0]
    assert run_command("reconstruct", tmp_path, *options) == 1
    said = capsys.readouterr().out
    assert f"({tmp_path / 'a.png'}: the file is empty)" in said
    assert "the run failed" in said


def test_the_command_writes_tables_models_a_database_and_a_page(demo, small_recipe, tmp_path):
    images = demo.train_dir / "courtyard" / "images"
    out = tmp_path / "out"
    # The matches at 320 and 400 pixels are too few with some versions of OpenCV
    text = small_recipe.read_text()
    small_recipe.write_text(text.replace("320", "480").replace("400", "640"))
    options = ["--recipe", small_recipe, "--format", "imc2025", "--workers", 0]
    assert run_command("reconstruct", images, "--out", out, *options) == 0
    results = {"cameras.csv", "submission.csv", "database.db", "models/0/images.bin", "report.html"}
    results |= {
        "sparse/0/points3D.bin",
        *(f"images/{path.name}" for path in images.iterdir()),
    }
    assert results <= contents(out).keys()
    with (out / "submission.csv").open() as stream:
        assert [row["image"] for row in csv.DictReader(stream)] == sorted(
            path.name for path in images.iterdir()
        )


def test_the_command_fails_if_only_an_earlier_runs_cameras_are_left(
    demo, small_recipe, tmp_path, monkeypatch, capsys
):
    *files, last = sorted((demo.train_dir / "courtyard" / "images").iterdir())
    root = tmp_path / "images"
    root.mkdir()
    for file in files:
        shutil.copy(file, root)
    text = small_recipe.read_text()
    small_recipe.write_text(text.replace("320", "480").replace("400", "640"))
    command = ["reconstruct", root, "--out", tmp_path / "out", "--recipe", small_recipe]
    command += ["--workers", 0]
    assert run_command(*command) == 0
    shutil.copy(last, root)
    with monkeypatch.context() as patched:
        scenes_by(patched, partial(befall, fail))
        capsys.readouterr()
        assert run_command(*command) == 1
        said = capsys.readouterr().out
        assert "by an earlier run" in said
        assert "No space left on device" in said
    assert run_command(*command) == 0
    assert "by an earlier run" not in capsys.readouterr().out


def photographs(folder: Path, count: int) -> list[Path]:
    """Overlapping parts of two photographs, one after the other."""
    folder.mkdir()
    paths = []
    for name in ("china.jpg", "flower.jpg"):
        picture = load_sample_image(name)[..., ::-1]
        for number in range(count):
            paths.append(folder / f"{name[:-4]}{number}.png")
            cv2.imwrite(
                str(paths[-1]), picture[20 + number : 360 + number, 12 * number : 12 * number + 420]
            )
    return paths


def test_a_shortlist_has_images_that_are_alike_and_none_that_cannot_be_read(tmp_path, monkeypatch):
    paths = photographs(tmp_path / "images", 6)
    features = [*map(local_features, paths)]
    partners = most_alike(lambda: features, 3)
    # Large folders are compared in parts.
    monkeypatch.setattr(likeness, "COMPARED_AT_A_TIME", 2)
    assert most_alike(lambda: features, 3) == partners
    pairs = shortlist(partners)
    assert pairs == sorted(set(pairs))
    assert all((i < 6) == (j < 6) and i < j for i, j in pairs)
    assert {place for pair in pairs for place in pair} == set(range(12))
    # Without features, images are in the order of their names.
    nothing = [local_features(tmp_path / f"{number}.png") for number in range(3)]
    assert shortlist(most_alike(lambda: nothing, 1)) == [(0, 1), (0, 2)]


def test_images_of_different_places_are_in_no_pair_unless_they_have_no_features(tmp_path):
    paths = photographs(tmp_path / "images", 4)
    blank = np.zeros((340, 420, 3), np.uint8)
    paths.append(tmp_path / "blank.png")
    cv2.imwrite(str(paths[-1]), blank)
    features = [*map(largest_features, paths)]
    assert {len(each) % 128 for each in features} == {0}
    pairs = overlapping(features)
    # The matcher reports what is wrong with an image without features.
    with_blank = {(number, 8) for number in range(8)}
    within = {(i, j) for i, j in combinations(range(8), 2) if (i < 4) == (j < 4)}
    assert with_blank | within <= set(pairs)
    # 16 pairs are of different places; single ones pass.
    assert len(pairs) < len(with_blank | within) + 5
    assert pairs == sorted(set(pairs))
    # If most images overlap, a mistake costs more than the pairs that it saves.
    assert overlapping(features[:4]) == list(combinations(range(4), 2))
    mostly_one_place = [features[0]] * 8 + [features[4]]
    assert overlapping(mostly_one_place) == list(combinations(range(9), 2))


def test_in_a_folder_of_many_images_only_pairs_that_may_overlap_are_matched(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(choice, "MIN_FILTERED", 5)
    photographs(tmp_path / "images", 3)
    result = run(tmp_path / "images", tmp_path / "out", UprightSift())
    names = [[path.stem[:-1] for path in pair.images] for pair in result.pairs]
    assert len(names) == 6
    assert all(first == second for first, second in names)
    assert "6 of 15 pairs may overlap" in capsys.readouterr().out
    # Known from the journal
    monkeypatch.setattr(choice, "largest_features", None)
    again = run(tmp_path / "images", tmp_path / "out", UprightSift())
    assert again.pairs == result.pairs


def test_all_pairs_are_matched_if_the_images_cannot_be_compared(tmp_path, monkeypatch):
    monkeypatch.setattr(choice, "MIN_FILTERED", 5)

    def broken(*_: object) -> None:
        raise RuntimeError("no")

    monkeypatch.setattr(choice, "overlaps", broken)
    photographs(tmp_path / "images", 3)
    result = run(tmp_path / "images", tmp_path / "out", UprightSift())
    assert len(result.pairs) == 15


class UprightSift(SyntheticMatcher):
    """SIFT that takes every keypoint for upright, so that it knows no turned image again."""

    def encode(self, pictures):
        sift = cv2.SIFT_create(1000)
        found = []
        for picture in pictures:
            gray = cv2.cvtColor(picture.pixels, cv2.COLOR_RGB2GRAY)
            keypoints = sift.detect(gray, None)
            for keypoint in keypoints:
                # A descriptor that ignores the orientation matches no turned image.
                keypoint.angle = 0
            found.append(sift.compute(gray, keypoints))
        return found

    def _match(self, seen0, seen1):
        near = cv2.BFMatcher().knnMatch(seen0[1], seen1[1], k=2)
        good = [first for first, second in near if first.distance < 0.75 * second.distance]
        ends = [seen0[0][m.queryIdx].pt for m in good], [seen1[0][m.trainIdx].pt for m in good]
        return Matches(*ends, np.ones(len(good)))


def test_images_that_lie_on_a_side_are_found(tmp_path):
    paths = photographs(tmp_path / "images", 4)
    # Some of both photographs, in all directions
    turned = {paths[1]: 1, paths[3]: 2, paths[6]: 3}
    for path, times in turned.items():
        cv2.imwrite(str(path), np.rot90(cv2.imread(str(path)), -times))
    (tmp_path / "images" / "broken.png").write_bytes(b"no picture")
    result = run(tmp_path / "images", tmp_path / "out", UprightSift(), rotations=True)
    found = {
        path: t
        for pair in result.pairs
        for path, t in zip(pair.images, pair.turns, strict=True)
        if t
    }
    assert found == turned
    # A prune keeps the trials, which the run has used.
    with Store.open(tmp_path / "out" / "work") as store:
        store.prune(Published.of(store).keys)
    again = run(tmp_path / "images", tmp_path / "out", UprightSift(), rotations=True)
    assert again.pairs == result.pairs
    assert again.report.units_run == 0


def test_what_was_turned_comes_back_in_the_pixels_of_its_file(tmp_path, monkeypatch):
    root = write_flat(tmp_path / "images", FIRST)
    # Its file is turned, so the matcher sees it upright only after a turn.
    lying = root / "02.png"
    cv2.imwrite(str(lying), np.rot90(cv2.imread(str(lying)), -1))
    monkeypatch.setattr("mkpc_kaggle.reconstruction.choice.find_turns", lambda *_: {lying: 1})
    result = run(root, tmp_path / "out", rotations=True)
    found = {name: record.camera for name, record in cameras(result).items()}
    downs = np.array([found[f"{number:02}.png"].R[1] for number in range(FIRST)])
    np.testing.assert_allclose(downs @ downs[0] > 0.9, [number != 2 for number in range(FIRST)])
    assert found["02.png"].R[0] @ downs[0] < -0.9  # the right border of the file is up
    truth = MixedMatcher().scenes[0].cameras["0002"]
    assert found["02.png"].K[0, 0] == pytest.approx(truth.K[0, 0], rel=0.03)
    image = pycolmap.Reconstruction(tmp_path / "out" / "models" / "0").find_image_with_name(
        "02.png"
    )
    assert (image.camera.width, image.camera.height) == (SIZE.height, SIZE.width)


def test_the_tables_are_there_at_first_and_again_after_each_scene(tmp_path):
    for name in ("a", "b"):
        write_flat(tmp_path / "images" / name, 4)
    published = []

    def publish(found: Cameras) -> None:
        (tmp_path / "out" / "cameras.csv").touch()
        published.append({name: sum(map(bool, each.values())) for name, each in found.items()})

    run(tmp_path / "images", tmp_path / "out", publish=publish)
    # Scenes of several datasets may end in either order.
    steps = list(dict.fromkeys(tuple(each.values()) for each in published))
    assert steps in ([(0, 0), (4, 0), (4, 4)], [(0, 0), (0, 4), (4, 4)])
