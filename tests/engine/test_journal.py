"""The journal: what is saved is read again, what is current follows from its inputs, damage has a name."""

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rectified import SECOND, SWEEP, THIRD

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.jobs import Estimated, Outcome, PairPoints, WantedPair
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.journal_reader import About, Event, EventKind, SceneRecord
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.reconstruction import RegisteredImage, SfmModel, Sigmas
from mkpc_kaggle.scene.view_graph import BatchImage

UNITS = {SWEEP.name: "s1", SECOND.name: "s2", THIRD.name: "s3"}
F = np.arange(1.0, 10.0).reshape(3, 3)
REGIONS = (
    CriticalRegion(Box(1, 2, 30, 40), RegionReason.CROPPED, 3, 2),
    CriticalRegion(Box(0, 0, 5, 6), RegionReason.TOO_SMALL),
)


def wanted(count: int, settings: str = "e") -> list[WantedPair]:
    """Pairs of a batch, each with its own image and a common one."""
    return [
        WantedPair(Pair(f"p{n}", "one", f"{n}.png", "c.png"), (f"{n}.png", "c.png"), settings)
        for n in range(count)
    ]


def want(journal: Journal, *units: Unit, count: int = 3, settings: str = "e", scene: str = "s") -> None:
    chosen = [(unit, UNITS[unit.name]) for unit in units or (SWEEP, SECOND)]
    journal.want(wanted(count, settings), chosen, {"one": scene}, About({"name": "x"}))


def match(journal: Journal, position: int, *units: Unit, digest: str = "d") -> None:
    """Save points of a pair whose images have these contents."""
    rng = np.random.default_rng(position)
    matches = Matches(rng.random((30, 2)), rng.random((30, 2)), rng.random(30))
    images = BatchImage(f"{position}.png", digest, Size(80, 60)), BatchImage("c.png", "common", Size(80, 60), 99.0)
    found = tuple(UnitResult(unit, matches, 0.5, 0.25) for unit in units)
    journal.save_outcomes([Outcome(position, images, found, REGIONS, "", 0.1, 0.2)], UNITS)


def estimate(journal: Journal, position: int) -> None:
    inputs = tuple(journal.inputs(position).values())
    journal.save_estimates([Estimated(position, inputs, tuple(range(7, 7 + len(inputs))), F, magsac=2 * F)])


def reconstruct(journal: Journal, *positions: int) -> None:
    camera = Camera(np.diag([500.0, 500, 1]), np.eye(3)[[1, 0, 2]], np.array([0.0, 0.0, 1.0]))
    sigmas = {"0.png": Sigmas(0.1, 0.02, 3.0), "1.png": ()}
    placed = [RegisteredImage(BatchImage(name, "d", Size(80, 60)), camera, 9, sigmas[name]) for name in sigmas]
    model = SfmModel(tuple(placed), np.array([[0.0, 0.0, 5.0]]), 0.7)
    scene = SceneRecord("one", 2, 2, 9, 1.5, "", (model,))
    pairs, unit = [], Unit(1, "x", 9)
    for position in positions:
        images, revisions = journal.images(position), journal.inputs(position).values()
        pairs.append(PairPoints(position, (images[0], images[1]), tuple((unit, number) for number in revisions)))
    choices = [Choice(3 * F, Reason.SCENE), *[Choice(None, Reason.UNREGISTERED)] * (len(pairs) - 1)]
    journal.save_scene(scene, journal.batch_inputs("one"), pairs, choices)


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    with Journal(tmp_path) as journal:
        want(journal)
        yield journal


@pytest.fixture
def whole(journal: Journal) -> Journal:
    """Two of three pairs with points, estimates and a scene."""
    for position in (0, 1):
        match(journal, position, SWEEP, SECOND)
        estimate(journal, position)
    reconstruct(journal, 0, 1)
    journal.note(Event(EventKind.FAULT, 0.0, os.fsdecode(b"\xff")))
    return journal


def had(journal: Journal) -> list[tuple[int, int]]:
    return [
        (position, int(unit)) for position, units, *_ in journal.states() for unit in sorted((units or "").split())
    ]


def estimated(journal: Journal) -> set[int]:
    return {position for position, _, _, F, *_ in journal.states() if F is not None}


def test_what_is_saved_is_read_after_opening_again(whole: Journal, tmp_path: Path) -> None:
    before = whole.records(), whole.scenes()
    whole.close()
    with Journal(tmp_path) as again:
        records, scenes = again.records(), again.scenes()
        assert [record.source for record in records] == ["scene", "pair", "fallback"]
        found = [(unit.unit, unit.matches, unit.inliers) for unit in records[1].units]
        assert found == [(SWEEP.name, 30, 7), (SECOND.name, 30, 8)]
        assert records[0].regions == REGIONS
        assert np.array_equal(records[0].chosen_fundamental, 3 * F)
        assert np.array_equal(records[0].magsac_fundamental, 2 * F)
        assert scenes == before[1]
        (model,), (known,) = scenes["one"].models, before[1]["one"].models
        assert (model.points.tolist(), model.reprojection_error) == ([[0.0, 0.0, 5.0]], 0.7)
        for image, other in zip(model.images, known.images, strict=True):
            assert (image.image, image.points, image.sigmas) == (other.image, other.points, other.sigmas)
            for part in ("K", "R", "t"):
                assert np.array_equal(getattr(image.camera, part), getattr(other.camera, part))
        assert [record.units for record in records] == [record.units for record in before[0]]
        (points,) = again.points([again.inputs(0)[SWEEP.name]]).values()
        assert points.points0.tobytes() == np.random.default_rng(0).random((30, 2)).astype(np.float32).tobytes()
        assert again.events()[-1].text == "\\udcff"
        assert again.about().recipe == {"name": "x"}


CHANGES = {  # and: pairs with all points of before, with a current estimate, and whether the scene is current
    "nothing": (want, (2, 2, True)),
    "unit added": (lambda j: want(j, SWEEP, SECOND, THIRD), (2, 2, True)),
    "unit removed": (lambda j: want(j, SWEEP), (2, 0, False)),
    "threshold": (lambda j: want(j, settings="other"), (2, 0, False)),
    "scene": (lambda j: want(j, scene="other"), (2, 2, False)),
    "pair added": (lambda j: want(j, count=4), (2, 2, True)),
    "order": (lambda j: want(j, SECOND, SWEEP), (2, 0, False)),
    "content": (lambda j: j.save_digest("0.png", "new"), (1, 1, False)),
    "content of second images": (lambda j: j.save_digest("c.png", "new"), (0, 0, False)),
    "more points": (lambda j: match(j, 2, SWEEP), (3, 2, False)),
}


@pytest.mark.parametrize(("change", "current"), CHANGES.values(), ids=CHANGES)
def test_a_row_is_current_if_today_has_the_same_inputs_and_settings(
    whole: Journal, change: Callable[[Journal], None], current: tuple[int, int, bool]
) -> None:
    change(whole)
    pairs = {position for position, _ in had(whole)}
    estimates = sum(bool(is_current) for *_, is_current in whole.states())
    assert (len(pairs), estimates, bool(whole.current_scenes())) == current


def test_former_rows_are_current_again_when_the_former_settings_return(whole: Journal) -> None:
    want(whole, SWEEP, settings="other", scene="other")
    estimate(whole, 0)
    reconstruct(whole, 0)
    want(whole)
    assert sum(bool(is_current) for *_, is_current in whole.states()) == 2
    assert whole.current_scenes() == {"one"}


def test_the_latest_rows_stand_in_until_there_are_current_ones_but_not_for_another_image(whole: Journal) -> None:
    want(whole, settings="other", scene="other")
    assert estimated(whole) == {0, 1}
    assert set(whole.scenes()) == {"one"}
    match(whole, 0, SWEEP, SECOND, digest="new")
    assert estimated(whole) == {1}
    assert whole.scenes() == {}


def test_rows_of_the_same_images_share_their_points_and_turned_images_are_others(journal: Journal) -> None:
    pairs = [*wanted(2), replace(wanted(1)[0], pair=replace(wanted(1)[0].pair, id="again"))]
    journal.want(pairs, [(SWEEP, "s1")], {})
    match(journal, 0, SWEEP)
    assert had(journal) == [(0, 0), (2, 0)]
    assert [journal.twins(position) for position in range(3)] == [[0, 2], [1], [0, 2]]
    journal.want([replace(pairs[0], pair=replace(pairs[0].pair, turns=(1, 0)))], [(SWEEP, "s1")], {})
    assert had(journal) == []


def test_a_job_is_saved_whole_or_not_at_all(journal: Journal) -> None:
    with pytest.raises(KeyError):
        match(journal, 0, SWEEP, Unit(1, "unknown", 9))
    assert had(journal) == []
    match(journal, 0, SWEEP)
    assert had(journal) == [(0, 0)]


def test_what_a_full_disk_refuses_is_in_memory_and_written_when_there_is_room(tmp_path: Path) -> None:
    with Journal(tmp_path) as journal:
        want(journal, count=200)
        (pages,) = journal._db.execute("PRAGMA page_count").fetchone()
        journal._db.execute(f"PRAGMA max_page_count = {pages + 5}")
        for position in range(200):
            match(journal, position, SWEEP)
        assert "full" in journal.trouble and journal.is_in_memory
        assert len(had(journal)) == 200
        journal._file.execute("PRAGMA max_page_count = 100000")
    with Journal(tmp_path) as again:
        assert len(had(again)) == 200


DAMAGES = [
    ("UPDATE estimate SET F = zeroblob(72)", "zero or not finite"),
    ("PRAGMA ignore_check_constraints = ON; UPDATE points SET points = zeroblob(1000)", "CHECK constraint failed"),
    ("UPDATE region SET reason = 'x'", "RegionReason"),
    ("UPDATE choice SET reason = 'x'", "Reason"),
    ("UPDATE about SET value = '{'", "Expecting property name"),
    ("DROP TABLE points", "points"),
    ("PRAGMA writable_schema = ON; UPDATE sqlite_master SET sql = 'x' WHERE name = 'scene'", ""),
]


@pytest.mark.parametrize(("damage", "told"), DAMAGES)
def test_damage_is_named(whole: Journal, tmp_path: Path, damage: str, told: str) -> None:
    whole.close()
    with closing(sqlite3.connect(tmp_path / "journal.sqlite")) as db:
        db.executescript(damage)
    named = pytest.raises(UserError, match=rf"journal\.sqlite is damaged \(.*{told}.*delete it with --fresh")
    with named, Journal(tmp_path) as journal:
        journal.about(), journal.records(), journal.scenes(), journal.events()
        for position in range(2):
            journal.points(journal.inputs(position).values())
    with Journal(tmp_path, fresh=True) as journal:
        want(journal)
        assert had(journal) == []


def test_a_journal_of_another_format_and_an_old_sqlite_are_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(sqlite3.connect(tmp_path / "journal.sqlite")) as db:
        db.execute("CREATE TABLE run (key TEXT PRIMARY KEY, value TEXT NOT NULL)")  # as format 10
    with pytest.raises(UserError, match=r"another version of this program \(its format is not \d+\).*--fresh"):
        Journal(tmp_path)
    Journal(tmp_path, fresh=True).close()
    monkeypatch.setattr(sqlite3, "sqlite_version_info", (3, 36, 0))
    with pytest.raises(UserError, match=r"Python needs 3\.37 or newer"):
        Journal(tmp_path)


def test_files_in_the_place_of_the_journal_or_its_lock_are_named(tmp_path: Path) -> None:
    for number, name in enumerate(("journal.lock", "journal.sqlite")):
        directory = tmp_path / str(number)
        directory.mkdir()
        os.mkfifo(directory / name)
        with pytest.raises(UserError, match=f"{name} is not a regular file"):
            Journal(directory)
    (tmp_path / "journal.lock").write_bytes(b"not a database" * 100)
    with pytest.raises(UserError, match=r"journal\.lock is damaged .*remove it"):
        Journal(tmp_path)


def test_a_refused_journal_holds_no_lock_and_no_file(tmp_path: Path) -> None:
    Journal(tmp_path).close()
    (tmp_path / "journal.sqlite").write_bytes(b"not a database" * 100)
    with pytest.raises(UserError) as caught:
        Journal(tmp_path)
    assert caught  # as a notebook keeps the last traceback
    open_files = [str(link.readlink()) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    assert not [name for name in open_files if name.startswith(str(tmp_path))]
    Journal(tmp_path, fresh=True).close()
