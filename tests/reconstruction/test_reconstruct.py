"""Folders of photographs in, cameras out: by the function and by the command."""

import hashlib
import os
import shutil
import signal
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
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
from synthetic import QUICK, SyntheticMatcher

from benchmarks.synthetic_scene import SIZE, SyntheticScene, synthetic_scene
from mkpc_kaggle import results
from mkpc_kaggle.data.images import TURNS
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.session import Session
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.adapters.sift import SiftMatcher, SiftOptions
from mkpc_kaggle.recipe import CameraModel, Recipe, SceneConfig, Unit
from mkpc_kaggle.reconstruction.run import for_cameras, reconstruct
from mkpc_kaggle.scene.models import SfmModel
from mkpc_kaggle.setup.assembly import assemble
from mkpc_kaggle.signals import Interrupt

PAGES = {"report.html"}  # it tells of times
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
        for scene, start, count in (
            (self.scenes[0], 0, FIRST),
            (self.scenes[1], FIRST, SECOND),
        ):
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
    root: Path, out: Path, matcher: SyntheticMatcher | None = None, **options: object
) -> tuple[SfmModel, ...]:
    given = {"synthetic": matcher or MixedMatcher()}
    return reconstruct(
        root, out, RECIPE, device="cpu", matchers=given, progress=False, **options
    )


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[SfmModel, ...]]:
    home = tmp_path_factory.mktemp("mixed")
    return home / "out", run(write_flat(home / "images"), home / "out")


def names_of(model: SfmModel) -> list[str]:
    return [found.image.name for found in model.images]


def contents(out: Path) -> dict[str, str]:
    """What a run left, but for its journal; of a database its rows, since SQLite counts who has
    opened it.
    """
    found = {}
    for path in sorted(out.rglob("*")):
        if path.suffix == ".db":
            with closing(sqlite3.connect(path)) as database:
                found[str(path.relative_to(out))] = "".join(database.iterdump())
        elif path.is_file() and "work" not in path.relative_to(out).parts:
            found[str(path.relative_to(out))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def test_mixed_scenes_are_a_model_each_and_foreign_images_are_in_none(mixed):
    out, models = mixed
    expected = [[f"{n:02}.png" for n in range(6)], [f"{n:02}.png" for n in range(6, 10)]]
    # The foreign image has wrong matches with all others.
    assert list(map(names_of, models)) == expected
    for number, names in enumerate(expected):
        model = pycolmap.Reconstruction(out / "models" / str(number))
        assert (
            sorted(image.name for image in model.images.values() if image.has_pose) == names
        )
        assert model.num_points3D() == len(models[number].points) > 100
    assert not (out / "models" / "2").exists()
    assert (out / "report.html").exists()


def test_the_table_has_the_cameras_of_the_models_and_they_are_right(mixed):
    out, _ = mixed
    truth = MixedMatcher().scenes[0].cameras
    model = pycolmap.Reconstruction(out / "models" / "0")
    table = pd.read_csv(out / "cameras.csv", index_col="image")
    for image in model.images.values():
        row = table.loc[image.name]
        K, R, t = (np.array(row[name].split(";"), float) for name in "KRt")
        pose = image.cam_from_world().matrix()
        np.testing.assert_allclose(R.reshape(3, 3), pose[:, :3], atol=1e-9)
        np.testing.assert_allclose(t, pose[:, 3], atol=1e-9)
        expected = image.camera.calibration_matrix()[:2, 2]
        np.testing.assert_allclose(K.reshape(3, 3)[:2, 2] + 0.5, expected)
        assert K[0] == pytest.approx(truth["00" + image.name[:2]].K[0, 0], rel=0.03)
        assert row["points"] == image.num_points3D
        parameters = np.array(row["parameters"].split(), float)
        np.testing.assert_allclose(parameters, image.camera.params)
    assert list(table["model"]) == [0] * FIRST + [1] * SECOND


def test_the_table_of_a_run_is_a_table_of_known_cameras(mixed, tmp_path):
    out, _ = mixed
    shutil.copy(out / "cameras.csv", tmp_path / "known.csv")
    (model, *_) = run(
        out.parent / "images", tmp_path / "out", intrinsics=tmp_path / "known.csv"
    )
    table = pd.read_csv(out / "cameras.csv", index_col="image")
    for found in model.images:
        expected = table.loc[found.image.name, "parameters"].split()
        np.testing.assert_allclose(found.lens.parameters, np.array(expected, float))


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
    assert changed.scene.camera_model is CameraModel.SIMPLE_RADIAL
    # A larger folder starts from fewer tracks by recipe auto alone, with any matchers.
    assert (changed.scene.all_tracks < SceneConfig().all_tracks) == (name == "auto")


ORIENTATIONS = (1, 6, 8, 3, 6, 1)  # of the images of a phone, by EXIF


def test_colmap_goes_on_with_photographs_that_exif_turns(tmp_path):
    root = write_flat(tmp_path / "images", FIRST)
    out = tmp_path / "out"
    for number, orientation in enumerate(ORIENTATIONS):
        path = root / f"{number:02}.png"
        cv2.imwrite(str(path), np.rot90(flat(number, SIZE), -TURNS.get(orientation, 0)))
        set_exif(path, orientation)
    # Undistorted pictures of a lens would be smaller.
    (found,) = run(root, out, settings={"scene.camera_model": "SIMPLE_PINHOLE"})
    sizes = {
        f"{n:02}.png": SIZE if o in (1, 3) else SIZE[::-1] for n, o in enumerate(ORIENTATIONS)
    }
    assert {image.image.name: image.image.size for image in found.images} == sizes
    # COLMAP's own mapper, from our database and the user's photographs
    settings = {
        "min_model_size": 3,
        "random_seed": 0,
        "extract_colors": True,
        "num_threads": 1,
    }
    options = pycolmap.IncrementalPipelineOptions(settings)
    (model,) = pycolmap.incremental_mapping(
        out / "database.db", root, tmp_path, options
    ).values()
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
        image.name: (image.camera.width, image.camera.height)
        for image in flattened.images.values()
    }
    assert undistorted == sizes
    truth = MixedMatcher().scenes[0].cameras
    for number, record in enumerate(found.images):
        stored = turned_camera(
            truth[f"{number:04}"], -TURNS.get(ORIENTATIONS[number], 0), SIZE
        )
        expected = stored.R @ truth["0000"].R.T
        np.testing.assert_allclose(
            record.camera.R @ found.images[0].camera.R.T, expected, atol=0.01
        )


def test_new_photographs_cost_their_own_pairs(tmp_path):
    root = write_flat(tmp_path / "images", FIRST - 1)
    first = MixedMatcher()
    run(root, tmp_path / "out", first)
    assert len(first.calls) == (FIRST - 1) * (FIRST - 2) // 2
    again = MixedMatcher()
    before = contents(tmp_path / "out")
    run(root, tmp_path / "out", again)
    assert not again.calls
    after = contents(tmp_path / "out")
    assert {name for name in after if after[name] != before[name]} <= PAGES
    more = MixedMatcher()
    (grown,) = run(write_flat(root, FIRST), tmp_path / "out", more)
    assert sorted(more.calls) == [(number, FIRST - 1) for number in range(FIRST - 1)]
    assert len(grown.images) == FIRST
    assert len(results(tmp_path / "out" / "work").pairs) == FIRST * (FIRST - 1) // 2
    fresh = Session(tmp_path / "out" / "work", Budget(0.0), Interrupt(), fresh=True)
    run(root, tmp_path / "out", session=fresh)
    assert len([*(tmp_path / "out" / "work" / "scenes").iterdir()]) == 1


def test_models_of_an_earlier_run_are_removed_once_no_image_has_a_match(tmp_path):
    root = write_flat(tmp_path / "images", 4)
    out = tmp_path / "out"
    run(root, out)
    for number, file in enumerate(sorted(root.iterdir())):
        cv2.imwrite(str(file), flat(FIRST + number, SIZE))
    assert run(root, out, MatcherOfNothing()) == ()
    assert {path.name for path in out.iterdir()} <= {"work", *PAGES}


def fail():
    raise OSError(28, "No space left on device")


def test_models_of_an_earlier_run_stay_if_the_scene_fails(tmp_path, monkeypatch, capfd):
    root = write_flat(tmp_path / "images", 4)
    out = tmp_path / "out"
    run(root, out)
    before = (out / "cameras.csv").read_text()
    write_flat(root, 5)
    with monkeypatch.context() as patched:
        scenes_by(patched, lambda job: befall(fail, job))
        run(root, out)
    assert "No space left on device" in capfd.readouterr().err
    assert (out / "cameras.csv").read_text() == before
    (model,) = run(root, out)
    assert len(model.images) == 5


def test_only_listed_pairs_are_matched(tmp_path):
    root = write_flat(tmp_path / "images" / "set", 4).parent
    # In the other order
    wanted = list(combinations(range(4), 2))[:5]
    lines = (f"set/{j:02}.png set/{i:02}.png\n" for i, j in wanted)
    (tmp_path / "pairs.txt").write_text("".join(lines))
    root = root.rename(tmp_path / os.fsdecode(b"caf\xe9"))
    matcher = MixedMatcher()
    run(root, tmp_path / "out", matcher, pairs=tmp_path / "pairs.txt")
    assert sorted(matcher.calls) == wanted


class StoppedMatcher(MixedMatcher):
    """Ctrl-C arrives while it matches its third pair."""

    def _match(self, *seen: object) -> Matches:
        if len(self.calls) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return super()._match(*seen)


def test_after_ctrl_c_the_same_call_continues(tmp_path):
    root = write_flat(tmp_path / "images", FIRST)
    former = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run(root, tmp_path / "out", StoppedMatcher())
    assert signal.getsignal(signal.SIGINT) is former
    rest = MixedMatcher()
    (model,) = run(root, tmp_path / "out", rest)
    assert 0 < len(rest.calls) < FIRST * (FIRST - 1) // 2
    assert len(model.images) == FIRST


def test_without_a_folder_for_results_the_models_are_returned_and_nothing_is_printed(
    tmp_path, capfd
):
    (model,) = run(write_flat(tmp_path / "images", FIRST), None)
    assert len(model.images) == FIRST
    assert capfd.readouterr() == ("", "")
    assert [path.name for path in tmp_path.iterdir()] == ["images"]


def refused(
    capsys: pytest.CaptureFixture[str], *words: object, recipe: str = "classical"
) -> str:
    assert run_command("reconstruct", *words, "--recipe", recipe) == 2
    return capsys.readouterr().err.splitlines()[-1]


def test_bad_input_is_refused_in_one_line(tmp_path, capsys):
    root = write_flat(tmp_path / "images", 3)
    out = tmp_path / "out"
    files = sorted(root.iterdir())
    assert f"{files[0]} is no folder; give the folder" in refused(
        capsys, *files, "--out", out
    )
    assert "contains, or lies in, the input" in refused(capsys, root, "--out", root / "out")
    table = tmp_path / "known.csv"
    table.write_text("image,model\n")
    assert "camera_model" in refused(capsys, root, "--out", out, "--intrinsics", table)
    assert "unknown recipe" in refused(capsys, root, "--out", out, recipe="none")
    assert not out.exists()


def test_the_command_writes_models_a_table_a_database_and_a_page(
    demo, small_recipe, tmp_path, capsys
):
    root = tmp_path / "images"
    shutil.copytree(demo.train_dir / "courtyard" / "images", root)
    names = sorted(path.name for path in root.iterdir())
    (root / "unreadable.jpg").write_bytes(b"no picture")
    (root / "notes.txt").touch()
    # The matches at 320 and 400 pixels are too few with some versions of OpenCV
    text = small_recipe.read_text()
    small_recipe.write_text(text.replace("320", "480").replace("400", "640"))
    out = tmp_path / "out"
    (tmp_path / "masks").mkdir()
    mask = np.full(cv2.imread(str(root / names[0])).shape[:2], 255, np.uint8)
    cv2.imwrite(str(tmp_path / "masks" / f"{names[0]}.png"), mask)
    options = ["--recipe", small_recipe, "--workers", 0, "--masks", tmp_path / "masks"]
    assert run_command("reconstruct", root, "--out", out, *options) == 0
    said = capsys.readouterr()
    assert "1 file not read: 1 .txt" in said.err
    assert f"masks: 1 of {len(names) + 1} images" in said.out
    assert f"{len(names)} of {len(names) + 1} images with a camera" in said.out
    assert "no camera for unreadable.jpg" in said.out
    expected = {"cameras.csv", "database.db", "models/0/images.bin", "sparse/0/points3D.bin"}
    expected |= {"report.html", *(f"images/{name}" for name in names)}
    assert expected <= contents(out).keys()


def test_a_folder_without_a_readable_image_fails(tmp_path, capsys):
    for name in ("a.png", "b.png", "c.png"):
        (tmp_path / name).write_bytes(b"")
    options = ["--out", f"{tmp_path}-out", "--recipe", "classical", "--workers", 0]
    assert run_command("reconstruct", tmp_path, *options) == 1
    said = capsys.readouterr()
    assert f"{tmp_path / 'a.png'}: the file is empty" in said.out
    assert "the run failed" in said.err
