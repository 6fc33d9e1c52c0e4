"""``mkpc_kaggle.reconstruct``: a run of the engine, called from a program."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from faulty import befall, scenes_by
from test_reconstruct import FIRST, RECIPE, MixedMatcher, fail, write_flat

from mkpc_kaggle import reconstruct, results
from mkpc_kaggle.engine.store import image_files
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec
from mkpc_kaggle.reconstruction import choice, python
from mkpc_kaggle.reconstruction.python import image_paths
from mkpc_kaggle.scene.models import SfmModel

PAIRS = FIRST * (FIRST - 1) // 2


def models(files: Sequence[Path], matcher: MixedMatcher, **options: object) -> tuple[SfmModel, ...]:
    given = {"synthetic": matcher}
    return reconstruct(files, RECIPE, device="cpu", matchers=given, **options)


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    return sorted(write_flat(tmp_path / "images", FIRST).iterdir())


def test_models_have_the_users_paths_all_points_and_pycolmaps_model(tmp_path, files, monkeypatch):
    monkeypatch.chdir(tmp_path)
    relative = [file.relative_to(tmp_path) for file in reversed(files)]
    made = models(relative, MixedMatcher(), progress=False)
    (model,) = made
    assert {found.image.name for found in model.images} == set(map(str, relative))
    truth = MixedMatcher().scenes[0].cameras
    for found in model.images:
        name = "00" + Path(found.image.name).stem
        assert found.focal == pytest.approx(truth[name].K[0, 0], rel=0.03)
    # The journal has fewer, and rounded.
    assert len(model.points) == model.colmap.num_points3D()
    known = {tuple(point.xyz) for point in model.colmap.points3D.values()}
    assert set(map(tuple, model.points)) == known


def test_progress_is_shown_and_can_be_switched_off(files, capfd):
    models(files, MixedMatcher())
    shown = capfd.readouterr()
    assert f"{PAIRS}/{PAIRS}" in shown.err
    assert not shown.out
    models(files, MixedMatcher(), progress=False)
    assert capfd.readouterr() == ("", "")


def test_a_work_directory_keeps_what_was_matched(tmp_path, files):
    work = tmp_path / "work"
    first = MixedMatcher()
    before = models(files[:-1], first, work_dir=work, progress=False)
    assert len(first.calls) == (FIRST - 1) * (FIRST - 2) // 2
    again = MixedMatcher()
    same = models(files[:-1], again, work_dir=work, progress=False)
    assert not again.calls
    np.testing.assert_array_equal(same[0].points, before[0].points)
    more = MixedMatcher()
    (grown,) = models(files, more, work_dir=work, progress=False)
    assert sorted(more.calls) == [(number, FIRST - 1) for number in range(FIRST - 1)]
    assert len(grown.images) == FIRST
    assert len(results(work).pairs) == PAIRS


class StoppedMatcher(MixedMatcher):
    """Ctrl-C arrives while it matches its third pair."""

    def _match(self, *seen: object) -> Matches:
        if len(self.calls) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return super()._match(*seen)


def test_after_ctrl_c_the_same_call_continues(tmp_path, files):
    former = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        models(files, StoppedMatcher(), work_dir=tmp_path / "work", progress=False)
    assert signal.getsignal(signal.SIGINT) is former
    rest = MixedMatcher()
    (model,) = models(files, rest, work_dir=tmp_path / "work", progress=False)
    assert 0 < len(rest.calls) < PAIRS
    assert len(model.images) == FIRST


def test_images_of_several_folders_are_one_set(tmp_path, files):
    # The same name in both folders
    moved = tmp_path / "images" / "more" / files[0].name
    moved.parent.mkdir()
    files[-1].rename(moved)
    work = tmp_path / "work"
    (model,) = models([*files[:-1], moved], MixedMatcher(), work_dir=work, progress=False)
    assert str(moved) in {found.image.name for found in model.images}
    found = results(work)
    pairs, cameras = found.pairs, found.cameras
    assert pairs["pair"].is_unique
    # Each image of a pair has a row, under the same name.
    for side in ("image0", "image1"):
        assert len(pairs.merge(cameras, left_on=side, right_on="image")) == PAIRS


def test_identical_files_have_a_camera_each(tmp_path, files):
    copy = files[0].with_name("copy.png")
    shutil.copy(files[0], copy)
    work = tmp_path / "work"
    (model,) = models([*files, copy], MixedMatcher(), work_dir=work, progress=False)
    by_name = {Path(found.image.name).name: found for found in model.images}
    assert set(by_name) == {file.name for file in (*files, copy)}
    first, second = by_name[files[0].name], by_name["copy.png"]
    np.testing.assert_array_equal(first.camera.R, second.camera.R)
    np.testing.assert_array_equal(first.camera.t, second.camera.t)
    assert len(model.colmap.images) == FIRST
    found = results(work)
    pairs, cameras = found.pairs, found.cameras
    assert sorted(cameras["image"]) == sorted(file.name for file in (*files, copy))
    assert {*pairs["image0"], *pairs["image1"]} == set(cameras["image"])
    assert found.scenes["missing"].tolist() == [()]


def test_the_images_of_a_folder_are_those_of_their_paths(tmp_path, files):
    (model,) = models(tmp_path / "images", MixedMatcher(), progress=False)
    assert {found.image.name for found in model.images} == set(map(str, files))
    (model,) = models(str(tmp_path / "images"), MixedMatcher(), progress=False)
    assert len(model.images) == FIRST


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda folder: (folder / "01.png").write_bytes(b""), "the file is empty"),
        (lambda folder: (folder / "01.png").unlink(), "01.png"),
        (lambda folder: (folder / "01.png").rename(folder / "00.jpg"), "rename one of them"),
    ],
    ids=["empty", "missing", "alike"],
)
def test_an_image_that_cannot_be_used_is_an_error_before_any_work(
    tmp_path: Path, files: list[Path], spoil: Callable[[Path], object], reason: str
):
    listed = [*files, tmp_path / "images" / "00.jpg"] if reason.startswith("rename") else files
    spoil(tmp_path / "images")
    matcher = MixedMatcher()
    with pytest.raises(UserError, match=reason):
        models([file for file in listed if file.exists() or "rename" not in reason], matcher)
    assert not matcher.calls


def test_a_colmap_folder_of_the_user_is_not_replaced(tmp_path, files):
    database = tmp_path / "project" / "colmap" / "database.db"
    database.parent.mkdir(parents=True)
    database.write_text("mine")
    with pytest.raises(UserError, match="was not made here"):
        models(files, MixedMatcher(), work_dir=tmp_path / "project", progress=False)
    assert database.read_text() == "mine"


def test_fewer_than_two_images_have_no_model_and_a_warning(files, capfd):
    for given, count in (([], "0 images"), (files[:1], "1 image")):
        assert models(given, MixedMatcher()) == ()
        assert f"no cameras: {count} given, and at least three" in capfd.readouterr().err


def test_a_folder_in_a_list_of_images_is_named(files):
    with pytest.raises(UserError, match=r"images\[1\]: .*images is a folder; give it alone"):
        models([files[0], files[0].parent], MixedMatcher())


def test_a_matcher_that_always_fails_is_an_error(files):
    class Broken(MixedMatcher):
        def _match(self, *_: object) -> Matches:
            raise RuntimeError("out of order")

    with pytest.raises(UserError, match="out of order"):
        models(files, Broken(), progress=False)


@pytest.mark.parametrize("calls_before", [0, 1])
def test_cameras_that_cannot_be_computed_are_an_error(tmp_path, files, monkeypatch, calls_before):
    work = tmp_path / "work"
    for _ in range(calls_before):
        models(files[:-1], MixedMatcher(), work_dir=work, progress=False)
    with monkeypatch.context() as patched:
        scenes_by(patched, partial(befall, fail))
        # The first failure may remove the former models' files, and the second call begins without.
        for _ in range(2):
            with pytest.raises(UserError, match="No space left on device; the same call tries"):
                models(files, MixedMatcher(), work_dir=work, progress=False)
    (model,) = models(files, MixedMatcher(), work_dir=work, progress=False)
    assert len(model.images) == FIRST


SCRIPT = """\
from pathlib import Path

from mkpc_kaggle import reconstruct
from test_reconstruct import RECIPE, MixedMatcher

given = {"synthetic": MixedMatcher()}
models = reconstruct(Path("images").iterdir(), RECIPE, device="cpu", matchers=given, progress=False)
print(len(models[0].images), "cameras")
"""


def test_a_script_needs_no_guard_although_scenes_are_computed_in_processes(tmp_path, files):
    # Without it, each worker would run the script again.
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    command = [sys.executable, script]
    done = subprocess.run(
        command, check=False, cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert (done.stdout, done.returncode) == (f"{FIRST} cameras\n", 0), done.stderr


class Unnamed(MixedMatcher):
    """A matcher whose code or weights may be others in each call."""

    version = ""

    @property
    def spec(self) -> MatcherSpec:
        return MatcherSpec(self.name, version=self.version)


def test_results_of_a_matcher_are_kept_only_under_its_version(tmp_path, files, capfd):
    kept = {}
    for version in ("", "1", "2", "1"):
        # Without a version, no later call takes the points of an earlier one.
        for _ in range(2):
            matcher = Unnamed()
            matcher.version = version
            models(files, matcher, work_dir=tmp_path / "work", progress=False)
            kept.setdefault(version, []).append(len(matcher.calls))
    assert kept == {"": [PAIRS, PAIRS], "1": [PAIRS, 0, 0, 0], "2": [PAIRS, 0]}
    line = "the results of synthetic are not kept for later calls: set MatcherSpec(version=...)"
    assert capfd.readouterr().err.count(line) == 2


def test_the_caller_decodes_no_photograph_and_names_one_that_is_cut_off(
    tmp_path, files, monkeypatch, capfd
):
    monkeypatch.setattr(python, "read_image", pytest.fail)
    cut = tmp_path / "images" / "99.png"
    cut.write_bytes(files[0].read_bytes()[:-2000])
    (model,) = models([*files, cut], MixedMatcher(), progress=False)
    assert len(model.images) == FIRST
    assert f"cannot be read: {cut}: cannot be read: " in capfd.readouterr().err


def test_a_large_folder_is_digested_once(tmp_path, files, monkeypatch):
    # Large folders have a shortlist of pairs, by the contents of all images.
    monkeypatch.setattr(choice, "MAX_IMAGES", 3)
    digested = []
    real = image_files.content_digest
    monkeypatch.setattr(
        image_files, "content_digest", lambda path: (digested.append(path.name), real(path))[1]
    )
    counts = []
    for _ in range(2):
        models(files, MixedMatcher(), work_dir=tmp_path / "work", progress=False)
        counts.append(len(digested))
    assert counts == [FIRST, FIRST]
    # A changed file is read again, and reported.
    files[0].write_bytes(files[0].read_bytes() + b"more")
    models(files, MixedMatcher(), work_dir=tmp_path / "work", progress=False)
    assert set(digested[FIRST:]) == {files[0].name}


class Blind(MixedMatcher):
    """Finds no match."""

    def _match(self, seen0: object, seen1: object) -> Matches:
        return Matches.empty()


def test_no_model_is_a_warning_with_its_reason(files, capfd):
    assert models(files, Blind(), progress=False) == ()
    assert "no cameras: no matches connect its images" in capfd.readouterr().err
    assert models(files[:2], MixedMatcher(), progress=False) == ()
    assert "at least three matched images are needed" in capfd.readouterr().err


def test_paths_may_be_a_column_of_a_table(files):
    names = [str(file) for file in files]
    for column in (pd.Series(names), np.array(names)):
        assert image_paths(column) == files
    for table in (pd.DataFrame({"path": names}), np.zeros((4, 5), np.uint8)):
        with pytest.raises(TypeError, match="expected a folder, or paths of images"):
            image_paths(table)
