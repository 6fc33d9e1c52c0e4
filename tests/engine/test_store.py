"""The store: what is put is read again, damage has a name, a full disk costs nothing, the rest can
be pruned.
"""

import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rectified import SECOND, SWEEP, THIRD, THREE_UNITS, RectifiedMatcher, matrices, run
from simulator import VirtualClock, memory_store

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine import run as engine_run
from mkpc_kaggle.engine.console import Progress
from mkpc_kaggle.engine.jobs import Estimated, MatchJob, Outcome, Phase
from mkpc_kaggle.engine.light import Estimating
from mkpc_kaggle.engine.matching import Matching
from mkpc_kaggle.engine.plan.budget import Budget, Costs
from mkpc_kaggle.engine.plan.state import EARLIER, FALLBACK, PAIR, State
from mkpc_kaggle.engine.publication import Publication
from mkpc_kaggle.engine.request import Ending, Request
from mkpc_kaggle.engine.restore import restore
from mkpc_kaggle.engine.run import EventLog, Run
from mkpc_kaggle.engine.scenes import SceneWork
from mkpc_kaggle.engine.store import database as store_module
from mkpc_kaggle.engine.store.database import FILE_NAME, Store
from mkpc_kaggle.engine.store.dataframes import (
    NOT_REACHED,
    matrices_of,
    pair_tables,
    read_results,
)
from mkpc_kaggle.engine.store.image_files import stored_digests
from mkpc_kaggle.engine.store.keys import Keys
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.engine.store.rows import to_bytes
from mkpc_kaggle.engine.store.scene_record import SceneRecord
from mkpc_kaggle.engine.store.sqlite_file import connected
from mkpc_kaggle.engine.store.tables import About, Feature, ImageFile, PairEstimate, UnitPoints
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit
from mkpc_kaggle.reporting.run_log import read_log, regions_of, write_csv
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.models import Reconstruction, RegisteredImage, SfmModel, Sigmas
from mkpc_kaggle.scene.sfm import Solution
from mkpc_kaggle.scene.view_graph import BatchImage

F = np.arange(1.0, 10.0).reshape(3, 3)
REGIONS = (
    CriticalRegion(Box(1, 2, 30, 40), RegionReason.CROPPED, 3, 2),
    CriticalRegion(Box(0, 0, 5, 6), RegionReason.TOO_SMALL),
)
RECIPE = replace(THREE_UNITS, units=(SWEEP, SECOND), scene=SceneConfig(pairs_per_image=0))
# No identity, so that rows and columns cannot be exchanged unnoticed
ROTATION = np.eye(3)[[1, 0, 2]]
CAMERA = Camera(np.diag([500.0, 500, 1]), ROTATION, np.array([0.0, 0.0, 1.0]))


def pair_of(number: int) -> Pair:
    """A pair of a batch, with its own image and a common one."""
    return Pair(f"p{number}", "one", f"{number}.png", "c.png")


def keys_of(recipe: Recipe, **other: str) -> Keys:
    units = tuple(unit.name for unit in recipe.units)
    return Keys(units, **{"mkpc": "m", "estimate": "e", "scene": "s"} | other)


class Room:
    """A store, and the state of a run of some pairs, whose answers are given by the test."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.ask()

    def ask(
        self,
        recipe: Recipe = RECIPE,
        count: int = 3,
        pairs: list[Pair] | None = None,
        extra: Sequence[Pair] = (),
        **other: str,
    ) -> None:
        """Begin a run, as the loop does. ``other`` are other settings."""
        pairs = pairs or [pair_of(number) for number in range(count)]
        request = Request(pairs, recipe, keys_of(recipe, **other), about=About({"name": "x"}))
        self.state = State(request, extra)
        names = [name for names in self.state.names for name in names]
        restore(self.state, self.store, stored_digests(self.store, names))
        budget = Budget(0.0)
        log = EventLog(self.store, budget)
        self.run = Run(self.state, self.store, Costs(), budget, log, Progress(budget, None))
        self.publication = Publication(self.state, self.store, budget, log)

    def match(self, index: int, *units: Unit, digest: str = "") -> None:
        """Save points of a pair whose first image has this content, by default its own."""
        matches = matches_of(index)
        name0, name1 = self.state.names[index]
        images = (
            BatchImage(name0, digest or name0, Size(80, 60)),
            BatchImage(name1, "common", Size(80, 60), 99.0),
        )
        found = tuple(UnitResult(unit, matches, 0.5, 0.25) for unit in units)
        outcome = Outcome(images, ((1, 1), (2, 2)), found, REGIONS, "", 0.1, 0.2)
        crops = (tuple(self.state.first_stage(index)),)
        job = MatchJob(Phase.SWEEP, (index,), units, (0.0,) * len(units), 0.0, crops=crops)
        Matching(self.run).save(job, [outcome], 0.5)

    def estimate(self, index: int) -> None:
        keys = tuple(self.state.inputs_of(index).points.values())
        each = Estimated(keys, tuple(range(7, 7 + len(keys))), F, magsac=2 * F)
        estimating = Estimating(self.run)
        estimating.save(estimating.job([index]), [each], 0.5)

    def reconstruct(self) -> None:
        state = self.state
        indices, _ = state.scene_inputs("one")
        sigmas = {"0.png": Sigmas(0.1, 0.02, 3.0), "1.png": ()}
        placed = [
            RegisteredImage(BatchImage(name, "d", Size(80, 60)), CAMERA, 9, sigmas[name])
            for name in sigmas
        ]
        model = SfmModel(tuple(placed), np.array([[0.0, 0.0, 5.0]]), 0.7)
        choices = [
            Choice(3 * F, Reason.SCENE),
            *[Choice(None, Reason.UNREGISTERED)] * (len(indices) - 1),
        ]
        answer = Solution((Reconstruction(tuple(sigmas), (model,)),), tuple(choices))
        reconstructing = SceneWork(self.run)
        reconstructing.save(reconstructing.job("one"), answer, 1.5)

    def publish(self) -> None:
        self.publication.publish()

    def replace(self, name: str) -> None:
        """Give an image another content, as the next start of a run notices."""
        self.store.put([ImageFile(name, "new", 3, 3)])
        self.ask()

    @property
    def standing(self) -> tuple[int, int, bool]:
        """The number of pairs with points of today, of estimates of today, and whether the scene
        is.
        """
        return (
            int(self.state.current.any(1).sum()),
            int(self.state.estimated.sum()),
            not self.state.stale,
        )


def matches_of(index: int) -> Matches:
    rng = np.random.default_rng(index)
    return Matches(rng.random((30, 2)), rng.random((30, 2)), rng.random(30))


def matches_in(store: Store, keys: Sequence[str]) -> dict[str, int]:
    """The number of matches of points, by key."""
    return {key: points.matches for key, points in store.get(UnitPoints, keys).items()}


def results_in(store: Store) -> set[str]:
    """The keys of all results of a store that a prune may remove."""
    return {row.key for kind in (UnitPoints, PairEstimate, SceneRecord) for row in store.all(kind)}


@pytest.fixture
def room(tmp_path: Path) -> Iterator[Room]:
    with Store.open(tmp_path) as store:
        yield Room(store)


@pytest.fixture
def whole(room: Room) -> Room:
    """Two of three pairs with points, estimates and a scene."""
    for index in (0, 1):
        room.match(index, SWEEP, SECOND)
        room.estimate(index)
    room.reconstruct()
    room.publish()
    return room


def test_stored_results_are_read_after_reopening(whole: Room, tmp_path: Path) -> None:
    before = pair_tables(whole.store)
    scenes_before = Published.of(whole.store).scenes_of(whole.store)
    whole.store.close()
    with Store.open(tmp_path) as again:
        published = Published.of(again)
        scenes = published.scenes_of(again)
        pairs, units, regions, estimates = pair_tables(again)
        assert pairs["source"].tolist() == ["scene", "pair", "fallback"]
        found = units[units["pair"] == "p1"][["unit", "matches", "inliers"]].to_numpy().tolist()
        assert found == [[SWEEP.name, 30, 7], [SECOND.name, 30, 8]]
        assert regions_of(regions[regions["pair"] == "p0"]) == REGIONS
        assert np.array_equal(matrices_of(pairs)[0], 3 * F)
        assert np.array_equal(estimates["magsac"][0], 2 * F)
        assert scenes == scenes_before
        (model,) = scenes["one"].models
        (known,) = scenes_before["one"].models
        assert (model.points.tolist(), model.reprojection_error) == ([[0.0, 0.0, 5.0]], 0.7)
        # The comparison of scenes leaves out their models.
        for image, other in zip(model.images, known.images, strict=True):
            assert image.image == other.image
            assert (image.points, image.sigmas) == (other.points, other.sigmas)
            for part in ("K", "R", "t"):
                assert np.array_equal(getattr(image.camera, part), getattr(other.camera, part))
        assert units.equals(before.units)
        points = published.points_of(again, published.rows[0])
        assert to_bytes(points[SWEEP.name]) == to_bytes(matches_of(0))
        assert published.run.about.recipe == {"name": "x"}


def test_results_are_data_frames_of_pairs_units_and_cameras(whole: Room, tmp_path: Path) -> None:
    pairs, units, cameras = read_results(tmp_path)
    assert pairs["pair"].tolist() == ["p0", "p1", "p2"]
    assert pairs["source"].tolist() == ["scene", "pair", "fallback"]
    assert pairs[["f11", "f33"]].iloc[0].tolist() == [3.0, 27.0]
    assert units.groupby("unit")["inliers"].sum().to_dict() == {SWEEP.name: 14, SECOND.name: 16}
    assert cameras[["image", "focal"]].to_numpy().tolist() == [["0.png", 500.0], ["1.png", 500.0]]
    assert cameras["centre_sigma"].isna().tolist() == [False, True]


# A change, then the number of pairs with points in use, the number of pairs whose estimate is up to
# date, and whether the scene is
CHANGES = {
    "nothing": (lambda room: room.ask(), (2, 2, True)),
    "unit added": (
        lambda room: room.ask(replace(RECIPE, units=(SWEEP, SECOND, SECOND_360))),
        (2, 2, True),
    ),
    "unit removed": (lambda room: room.ask(replace(RECIPE, units=(SWEEP,))), (2, 0, False)),
    # Until there are other estimates
    "threshold": (lambda room: room.ask(estimate="other"), (2, 0, False)),
    "scene": (lambda room: room.ask(scene="other"), (2, 2, False)),
    "crops": (lambda room: room.ask(mkpc="other"), (2, 0, False)),
    "pair added": (lambda room: room.ask(count=4), (2, 2, True)),
    "content": (lambda room: room.replace("0.png"), (1, 1, False)),
    "content of second images": (lambda room: room.replace("c.png"), (0, 0, False)),
    "more points": (lambda room: room.match(2, SWEEP), (3, 2, False)),
}
SECOND_360 = replace(SECOND, long_side=360)


@pytest.mark.parametrize(("change", "standing"), CHANGES.values(), ids=CHANGES)
def test_a_result_is_up_to_date_if_it_is_stored_under_todays_key(
    whole: Room, change, standing
) -> None:
    change(whole)
    assert whole.standing == standing


def test_new_points_of_stage_1_make_those_of_stage_2_out_of_date_but_the_run_uses_them(
    room: Room,
) -> None:
    recipe = replace(RECIPE, units=(SWEEP, SECOND, THIRD))
    room.ask(recipe)
    room.match(0, SWEEP, SECOND)
    assert room.state.current[0].tolist() == [True, True, False]
    room.match(0, THIRD)
    assert room.state.current[0].tolist() == [True, False, True]
    assert room.state.has[0].all()
    room.publish()
    room.ask(recipe)  # the next run has none but those of today
    assert room.state.current[0].tolist() == room.state.has[0].tolist() == [True, False, True]
    room.match(0, SECOND)
    assert room.state.current[0].all()


def test_an_image_that_is_put_back_has_its_results_again(whole: Room) -> None:
    whole.replace("0.png")
    assert whole.standing == (1, 1, False)
    whole.store.put([ImageFile("0.png", "0.png", 4, 4)])
    whole.ask()
    assert whole.standing == (2, 2, True)


def test_former_results_are_up_to_date_again_when_the_former_settings_return(whole: Room) -> None:
    # A user who compares two settings goes back and forth between them.
    whole.ask(replace(RECIPE, units=(SWEEP,)), estimate="other", scene="other")
    for index in (0, 1):
        whole.estimate(index)
    whole.reconstruct()
    whole.publish()
    whole.ask()
    assert whole.standing == (2, 2, True)


def test_the_f_of_the_last_table_stays_until_a_new_one_exists_unless_an_image_changed(
    whole: Room,
) -> None:
    before = [3 * F, F]  # of a scene, and of a pair
    # Again and again, as in runs that are interrupted at once.
    for other in ("first", "second"):
        whole.ask(replace(RECIPE, units=(THIRD,)), estimate=other, scene=other)
        assert whole.state.sources.tolist() == [EARLIER, EARLIER, FALLBACK]
        assert np.array_equal(whole.state.fundamentals[:2], before)
        assert not whole.state.has.any()
        assert not whole.state.scenes
        whole.publish()
        pairs = pair_tables(whole.store).pairs
        assert pairs["source"].tolist() == ["earlier", "earlier", "fallback"]
        assert pairs["failure"].tolist() == [NOT_REACHED] * 3
        assert pairs["error"].tolist() == [""] * 3
    whole.match(0, THIRD)
    whole.estimate(0)
    # An F of another image is worth nothing.
    whole.match(1, THIRD, digest="new")
    assert whole.state.sources.tolist() == [PAIR, FALLBACK, FALLBACK]
    assert np.array_equal(whole.state.fundamentals, [F, *[FALLBACK_FUNDAMENTAL] * 2])


def test_an_e_of_an_earlier_run_is_not_written_as_f(room: Room) -> None:
    known = replace(pair_of(0), intrinsics=(np.eye(3), np.eye(3)))
    room.ask(pairs=[known])
    room.match(0, SWEEP)
    room.estimate(0)
    room.publish()
    room.ask(pairs=[known], estimate="other")
    assert room.state.sources.tolist() == [EARLIER]
    room.ask(pairs=[pair_of(0)])
    assert room.state.sources.tolist() == [FALLBACK]


def test_reports_show_the_f_that_was_written_last_and_decide_nothing_themselves(
    whole: Room,
) -> None:
    # Stored, but not in the submission yet: the report must agree with the file.
    whole.match(2, SWEEP)
    whole.estimate(2)
    pairs = pair_tables(whole.store).pairs
    assert pairs[["source", "units"]].loc[2].tolist() == ["fallback", 0]
    assert np.array_equal(matrices_of(pairs)[2], FALLBACK_FUNDAMENTAL)
    whole.publish()
    pairs = pair_tables(whole.store).pairs
    assert pairs[["source", "units"]].loc[2].tolist() == ["pair", 1]
    assert np.array_equal(matrices_of(pairs)[2], F)


def test_what_an_extra_pair_got_as_a_row_or_by_another_recipe_does_not_change_a_scene(
    room: Room,
) -> None:
    extra = {"pairs": [pair_of(1), pair_of(2)], "extra": [pair_of(0)]}
    for index in range(3):
        room.match(index, SWEEP)
    room.ask(**extra)
    _, fresh = room.state.scene_inputs("one")
    room.ask()
    room.match(0, SECOND)
    room.estimate(0)
    room.ask(**extra)
    _, again = room.state.scene_inputs("one")
    assert again == fresh


def test_rows_of_the_same_images_share_their_points_and_turned_images_are_others(
    room: Room,
) -> None:
    pairs = [pair_of(0), pair_of(1), replace(pair_of(0), id="again")]
    room.ask(pairs=pairs)
    assert len(room.state.pairs) == 2
    room.match(0, SWEEP)
    room.estimate(0)
    assert [np.array_equal(written, F) for written in room.state.fundamentals] == [
        True,
        False,
        True,
    ]
    room.publish()
    rows = pair_tables(room.store).pairs
    assert rows["pair"].tolist() == ["p0", "p1", "again"]
    assert rows["source"].tolist() == ["pair", "fallback", "pair"]
    room.ask(pairs=[replace(pairs[0], turns=(1, 0))])
    assert not room.state.current.any()


def test_results_are_stored_all_or_none(room: Room) -> None:
    good = SceneRecord("one", seconds=1.0, key="a")
    for bad in (
        SceneRecord("one", seconds=np.nan, key="b"),
        SceneRecord("one", images=1.5, key="b"),
    ):
        with pytest.raises(sqlite3.IntegrityError):
            room.store.put([good, bad])
        assert room.store.get(SceneRecord, ["a", "b"]) == {}


def test_results_that_a_full_disk_refuses_stay_in_memory_and_are_written_later(
    tmp_path: Path,
) -> None:
    rows = [UnitPoints(f"key {n}", "u", n, data=bytes(600)) for n in range(200)]
    with Store.open(tmp_path) as store:
        # SQLite then reports a full disk after five more pages.
        (pages,) = store._db.execute("PRAGMA page_count").fetchone()
        store._db.execute(f"PRAGMA max_page_count = {pages + 5}")
        for row in rows:
            store.put([row])
        assert "full" in store.trouble
        assert matches_in(store, [row.key for row in rows]) == {
            row.key: row.matches for row in rows
        }
        # The worker that estimates F gets these points, too.
        last = rows[-1]
        assert store.source(UnitPoints, [last.key]).data([last.key]) == {last.key: last.data}
        # The user deletes files: the next write takes all.
        store._db.execute("PRAGMA max_page_count = 100000")
    with Store.read(tmp_path) as again:
        assert len(again.data(UnitPoints, [row.key for row in rows])) == 200


# Puts a result into the store in argv[1], and prints the results that it has, and why they stay in memory.
PUT = """
import resource, sys
from pathlib import Path
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.tables import UnitPoints

limit = 1024 * int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
with Store.open(Path(sys.argv[1])) as store:
    store.put([UnitPoints("new", "u", 2)])
    rows = store.get(UnitPoints, ["former", "new"])
    print({key: row.matches for key, row in rows.items()}, bool(store.trouble))
"""


# The file can have a first page, but SQLite's index of 32 kB fails.
@pytest.mark.parametrize("kib", [4, 20])
@pytest.mark.parametrize("former", [{}, {"former": 1}], ids=["new", "resumed"])
def test_a_disk_that_is_full_from_the_start_costs_no_result(
    tmp_path: Path, kib: int, former: dict[str, int]
) -> None:
    if former:
        with Store.open(tmp_path) as store:
            store.put(UnitPoints(key, "u", count) for key, count in former.items())
    process = put_into(tmp_path, kib)
    assert process.stderr == ""
    assert process.stdout == f"{former | {'new': 2}} True\n"


def put_into(directory: Path, kib: int) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-c", PUT, str(directory), str(kib)],
        check=False,
        text=True,
        capture_output=True,
    )


def test_a_disk_without_a_free_byte_is_refused_in_one_line(tmp_path: Path) -> None:
    last = put_into(tmp_path, 0).stderr.splitlines()[-1]
    assert last.endswith(
        f"UserError: the work directory {tmp_path} cannot be written: disk I/O error"
    )


class FullDisk:
    """A connection whose disk has no room for statements that begin with a word."""

    def __init__(self, connection: sqlite3.Connection, word: str) -> None:
        self._connection = connection
        self._word = word

    def execute(self, statement: str, *values: object) -> sqlite3.Cursor:
        if statement.startswith(self._word):
            raise sqlite3.OperationalError("database or disk is full")
        return self._connection.execute(statement, *values)

    def __getattr__(self, name: str) -> object:
        return getattr(self._connection, name)


@pytest.mark.parametrize(
    ("word", "outcome", "kept"),
    [("DELETE", "nothing was removed", True), ("VACUUM", "unused results are removed", False)],
)
def test_a_prune_on_a_full_disk_is_one_line_and_loses_nothing(
    whole: Room, tmp_path: Path, monkeypatch, word, outcome, kept
) -> None:
    whole.store.put([UnitPoints("unnamed", "u", data=bytes(1 << 16))])
    named = set(Published.of(whole.store).keys)
    whole.store.close()
    real = store_module.connected
    monkeypatch.setattr(
        store_module, "connected", lambda *options, **more: FullDisk(real(*options, **more), word)
    )
    told = rf"sqlite: {outcome}.*: database or disk is full; make room on the disk"
    with Store.open(tmp_path) as store, pytest.raises(UserError, match=told):
        store.prune(Published.of(store).keys)
    monkeypatch.undo()
    with Store.read(tmp_path) as store:
        assert results_in(store) == named | ({"unnamed"} if kept else set())


def test_a_prune_removes_what_the_table_of_pairs_does_not_name(whole: Room, tmp_path: Path) -> None:
    named = set(Published.of(whole.store).keys)
    unnamed = UnitPoints("unnamed", "u", data=bytes(1 << 20))
    features = Feature("features", data=b"kept")
    whole.store.put([unnamed, features])
    whole.store.close()
    before = (tmp_path / FILE_NAME).stat().st_size
    with Store.open(tmp_path) as store:
        freed = store.prune(Published.of(store).keys)
    assert freed >= 1 << 20
    assert (tmp_path / FILE_NAME).stat().st_size == before - freed
    with Store.read(tmp_path) as store:
        assert results_in(store) == named
        # Features belong to images, which the table of pairs does not name.
        assert store.data(Feature, ["features"]) == {"features": b"kept"}


DAMAGES = [
    (
        "PRAGMA writable_schema = ON; UPDATE sqlite_master SET sql = 'x' WHERE name = 'points'",
        "malformed",
    ),
]


@pytest.mark.parametrize(("damage", "told"), DAMAGES)
def test_only_what_sqlite_reports_as_damage_is_damage(
    whole: Room, tmp_path: Path, damage: str, told: str
) -> None:
    whole.store.close()
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db:
        db.executescript(damage)
    with pytest.raises(
        UserError, match=rf"journal\.sqlite is damaged \(.*{told}.*delete it with --fresh"
    ):
        Store.open(tmp_path)
    with Store.open(tmp_path, fresh=True) as store:
        assert store.all(UnitPoints) == []


def test_a_bug_in_a_reader_is_no_damage(whole: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    # "Delete your journal" would cost the user hours and hide the bug.
    monkeypatch.setattr("mkpc_kaggle.engine.store.dataframes.PARAMETERS", None)
    with pytest.raises(sqlite3.ProgrammingError):
        pair_tables(whole.store)


def test_an_error_of_the_disk_is_no_damage_and_no_bad_input(
    whole: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Failing:
        def execute(self, *_: object) -> None:
            error = sqlite3.OperationalError("disk I/O error")
            error.sqlite_errorcode = sqlite3.SQLITE_IOERR_READ
            raise error

    monkeypatch.setattr(whole.store, "_unsaved", {})
    healthy = whole.store._db
    whole.store._db = Failing()
    with pytest.raises(sqlite3.OperationalError, match="disk I/O error"):
        whole.store.get(UnitPoints, ["key"])
    whole.store._db = healthy


def test_a_store_of_another_format_and_an_old_sqlite_are_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db:
        db.execute("CREATE TABLE run (key TEXT PRIMARY KEY, value TEXT NOT NULL)")  # as format 10
        db.execute("PRAGMA user_version = 15")
    with pytest.raises(
        UserError, match=r"another version of this program \(its format is not \d+\).*--fresh"
    ):
        Store.open(tmp_path)
    Store.open(tmp_path, fresh=True).close()
    monkeypatch.setattr(sqlite3, "sqlite_version_info", (3, 36, 0))
    with pytest.raises(UserError, match=r"Python needs 3\.37 or newer"):
        Store.open(tmp_path)


def test_files_in_the_place_of_the_store_or_its_lock_are_named(tmp_path: Path) -> None:
    for name in ("journal.lock", "journal.sqlite"):
        directory = tmp_path / f"with {name}"
        directory.mkdir()
        # Opening a pipe without a writer would block forever.
        os.mkfifo(directory / name)
        with pytest.raises(UserError, match=f"{name} is not a regular file"):
            Store.open(directory)
    (tmp_path / "journal.lock").write_bytes(b"not a database" * 100)
    with pytest.raises(UserError, match=r"journal\.lock is damaged .*remove it"):
        Store.open(tmp_path)


def test_a_store_in_use_is_refused(tmp_path: Path) -> None:
    with Store.open(tmp_path), pytest.raises(UserError, match="is another run using it"):
        Store.open(tmp_path)


def test_a_refused_store_holds_no_lock_and_no_file(tmp_path: Path) -> None:
    Store.open(tmp_path).close()
    (tmp_path / FILE_NAME).write_bytes(b"not a database" * 100)
    with pytest.raises(UserError) as caught:
        Store.open(tmp_path)
    # A notebook keeps the last traceback, and with it the store's objects.
    assert caught
    links = [link for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    open_files = [str(link.readlink()) for link in links]
    assert not [name for name in open_files if name.startswith(str(tmp_path))]
    Store.open(tmp_path, fresh=True).close()


# Readers beside a run, other programs, and damage


def test_a_reader_that_has_the_file_open_neither_blocks_a_run_nor_is_blocked(
    whole: Room, tmp_path: Path
) -> None:
    whole.store.close()
    # A transaction, as of a backup or of a notebook
    with Store.read(tmp_path) as reader:
        before = pair_tables(reader).pairs
        with Store.open(tmp_path) as store:
            store.put([UnitPoints("new", "u", 1)])
            assert store.flush() == ""
            with Store.read(tmp_path) as other:
                assert matches_in(other, ["new"]) == {"new": 1}
        assert pair_tables(reader).pairs.equals(before)
    with Store.read(tmp_path) as again:
        assert matches_in(again, ["new"]) == {"new": 1}
    # Nor does a reader leave files of SQLite's behind.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["journal.lock", "journal.sqlite"]


@pytest.mark.parametrize("mode", ["DELETE", "WAL"])
def test_a_reader_of_a_copy_in_another_mode_does_not_block_a_run(
    whole: Room, tmp_path: Path, mode: str
) -> None:
    whole.store.close()
    with closing(connected(tmp_path / FILE_NAME)) as db:
        db.execute(f"PRAGMA journal_mode = {mode}")
    with closing(connected(tmp_path / FILE_NAME, "mode=ro")) as reader:
        reader.execute("BEGIN")
        assert reader.execute("SELECT count(*) FROM points").fetchone()[0] > 0
        with Store.open(tmp_path) as store:
            store.put([UnitPoints("new", "u", 1)])
            assert matches_in(store, ["new"]) == {"new": 1}


def test_readers_in_a_loop_beside_a_run_work_or_have_one_line(pairs, undisturbed, tmp_path) -> None:
    work = tmp_path / "work"
    ended = threading.Event()
    read = []
    refused = []

    def loop(tables: Path) -> None:
        while not ended.is_set():
            try:
                read.append(len(read_results(work).pairs))
                read_log(work)
                write_csv(work, tables)
            except UserError as error:
                refused.append(str(error))

    threads = [threading.Thread(target=loop, args=[tmp_path / name]) for name in "ab"]
    for thread in threads:
        thread.start()
    for _ in range(2):
        report = run(pairs, THREE_UNITS, RectifiedMatcher(seconds=0.005), work)
        assert (report.ending, report.faults) == (Ending.COMPLETE, ())
        assert matrices(report) == matrices(undisturbed)
    ended.set()
    for thread in threads:
        thread.join()
    assert 12 in read
    # Before the first table of pairs
    reasons = ("has no journal.sqlite", "has no results yet", "the run has not begun")
    assert [text for text in refused if not any(reason in text for reason in reasons)] == []


DAMAGED_ROWS = {
    "another number": "UPDATE points SET matches = 7",
    "truncated": "UPDATE points SET data = substr(data, 1, 7)",
    "empty": "UPDATE points SET data = x''",
    "other bytes": "UPDATE points SET data = zeroblob(length(data))",
    "no JSON": "UPDATE points SET regions = '{'",
    "no UTF-8": "UPDATE points SET note = CAST(x'ff41' AS TEXT)",
    "an estimate": "UPDATE estimate SET F = zeroblob(72)",
    "an image": "UPDATE image SET width = 7",
    "the run": "UPDATE run SET about = '{}'",
    "the table of pairs": "UPDATE pair SET points = '[]'",
    "F of the table": "UPDATE pair SET F = zeroblob(72)",
    "an event": "UPDATE event SET text = 'x' || text",
    "exchanged rows": "UPDATE points SET key = 'x' || key",
}


@pytest.mark.parametrize("name", DAMAGED_ROWS)
def test_a_row_that_does_not_fit_its_digest_is_missing_and_computed_again(
    pairs, undisturbed, tmp_path, name, capsys
) -> None:
    run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path)
    count = edit(tmp_path, DAMAGED_ROWS[name])
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        try:  # a reader has the other rows, or one line
            read_results(tmp_path)
            read_log(tmp_path)
        except UserError as error:
            assert "the run has not begun" in str(error)
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path)
    rows = "1 result" if count == 1 else f"{count} results"
    assert report.faults == (f"{rows} of the journal, damaged, will be computed again",)
    assert f"warning: {report.faults[0]}\n" in capsys.readouterr().err
    assert report.ending is Ending.COMPLETE
    assert matrices(report) == matrices(undisturbed)
    again = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path)
    assert (again.faults, again.units_run, again.estimated) == ((), 0, 0)
    assert len(read_results(tmp_path).units) == 36


def edit(directory: Path, script: str) -> int:
    """Change the file of a store as another program. Return the number of changed rows."""
    with closing(connected(directory / FILE_NAME)) as db:
        return db.execute(script).rowcount


TABLES = {
    "no table": "DROP TABLE points",
    "another table": "CREATE TABLE notes (text TEXT)",
    "a trigger": "CREATE TRIGGER t AFTER INSERT ON points BEGIN DELETE FROM points; END",
    "another column": "ALTER TABLE points ADD COLUMN more TEXT",
}


@pytest.mark.parametrize("script", TABLES.values(), ids=TABLES)
def test_other_tables_than_the_programs_are_damage_in_one_line(
    whole: Room, tmp_path: Path, script: str
) -> None:
    whole.store.close()
    edit(tmp_path, script)
    for use in (Store.open, Store.read):
        with pytest.raises(UserError, match=r"is damaged \(it has .*delete it with --fresh"):
            use(tmp_path)


def test_a_file_without_results_is_no_other_format(tmp_path: Path) -> None:
    (tmp_path / FILE_NAME).touch()
    with pytest.raises(UserError, match="has no results yet"):
        Store.read(tmp_path)


def test_a_lock_of_another_program_is_waited_for_once_in_half_a_minute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr("mkpc_kaggle.engine.store.database.monotonic", lambda: clock[0])
    with Store.open(tmp_path) as store, closing(connected(tmp_path / FILE_NAME)) as other:
        tried = []
        store._db.set_trace_callback(lambda text: tried.append("BEGIN" in text))
        other.execute("BEGIN IMMEDIATE")
        for number in range(60):
            clock[0] = float(number)
            store.put([UnitPoints(f"key {number}", "u", number)])
        assert sum(tried) == 2
        assert matches_in(store, ["key 59"]) == {"key 59": 59}
        assert "is locked" in store.trouble
        with pytest.raises(sqlite3.IntegrityError):  # also while nothing is written
            store.put([UnitPoints("bad", "u", match_seconds=np.nan)])
        other.execute("ROLLBACK")
        # The end of the run, which has lost nothing
        assert store.flush() == ""
        assert store.trouble == ""
    with Store.read(tmp_path) as again:
        assert len(again.all(UnitPoints)) == 60


def test_a_directory_that_is_moved_during_a_run_costs_no_result(
    pairs, undisturbed, tmp_path, monkeypatch
) -> None:
    moved = iter([tmp_path / "moved"])
    use = Matching._use

    def use_and_move(*arguments: object) -> None:
        use(*arguments)
        for target in moved:
            (tmp_path / "work").rename(target)

    monkeypatch.setattr(Matching, "_use", use_and_move)
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    assert matrices(report) == matrices(undisturbed)
    assert "was moved or removed during the run" in report.unsaved
    assert report.faults == (report.unsaved,)
    # The results went with the directory.
    again = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "moved")
    assert (again.units_run, again.estimated, again.faults) == (0, 0, ())


def test_a_log_that_is_overwritten_during_a_run_is_like_a_full_disk(
    pairs, undisturbed, tmp_path, monkeypatch
) -> None:
    spoilt = []
    use = Matching._use

    def use_and_spoil(self: Matching, index: int, *arguments: object) -> None:
        use(self, index, *arguments)
        # After the sweep, whose points the crops of the second unit come from
        if not spoilt and self._run.log.units_run == 11:
            log = tmp_path / f"{FILE_NAME}-wal"
            spoilt.append(log.stat().st_size)
            with log.open("r+b") as stream:
                stream.write(np.random.default_rng(0).bytes(spoilt[0]))

    monkeypatch.setattr(Matching, "_use", use_and_spoil)
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path)
    assert spoilt
    assert report.ending is Ending.COMPLETE
    assert matrices(report) == matrices(undisturbed)
    assert "the journal was damaged during the run" in report.unsaved
    monkeypatch.undo()
    # What the journal lost is computed again.
    again = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path)
    assert matrices(again) == matrices(undisturbed)
    assert again.unsaved == ""


def test_the_log_of_a_killed_run_in_a_read_only_directory_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = tmp_path / "work"
    with Store.open(work) as store:
        store.put([UnitPoints("in the log", "u", 1)])
        shutil.copytree(work, tmp_path / "killed")
    killed = tmp_path / "killed"
    before = {path.name: path.read_bytes() for path in killed.iterdir()}
    # As root, a test can write anywhere.
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    with Store.read(killed) as reader:
        # One transaction, after a kill
        assert matches_in(reader, ["in the log"]) == {"in the log": 1}
    assert {path.name: path.read_bytes() for path in killed.iterdir()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["killed", "work"], "no copy is left"


def test_the_lists_of_faults_and_decisions_end_at_a_number(monkeypatch):
    monkeypatch.setattr(engine_run, "MAX_FAULTS", 3)
    monkeypatch.setattr(engine_run, "MAX_PLANS", 3)
    log = EventLog(memory_store(), Budget(0.0, clock=VirtualClock()))
    for number in range(10):
        log.fault(f"fault {number}")
        log.explain(f"decision {number}")
    assert log.faults == ["fault 0", "fault 1", "fault 2", "further faults are not listed"]
    texts = [event.text for event in log.plans]
    assert texts == ["decision 0", "decision 1", "decision 2", "further decisions are not listed"]
