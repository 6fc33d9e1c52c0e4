"""The journal command and report.html, on journals with known contents."""

import csv
import json
import os
import re
import sys
from dataclasses import replace
from math import inf
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from browser import needs_browser, opened_browser
from rectified import THREE_UNITS, RectifiedMatcher, run, write_pairs
from run_tables import Described, tables_of
from shared import run_command

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.console import Event, EventKind, append_event
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.dataframes import matrices_of
from mkpc_kaggle.engine.store.tables import About, PublishedPair, PublishedRun
from mkpc_kaggle.geometry.robust import RobustConfig, sampson_distances
from mkpc_kaggle.recipe import Recipe
from mkpc_kaggle.reporting.report import DRAWING_S, pair_rows, remarks, report_page, report_run
from mkpc_kaggle.reporting.run_log import read_log
from mkpc_kaggle.reporting.summary import overview

# As a name of a file, and in all other texts that come from outside
EVIL = '<script>alert("$x$")</script>'


def a_run(directory: Path, count: int = 12, recipe: Recipe = THREE_UNITS) -> list[Pair]:
    """A run over pairs of which the second cannot be read; its work directory is
    ``directory``/work.
    """
    pairs = write_pairs(directory / "images", count)
    # The other images are read, and the run is complete.
    pairs[1].images[1].write_bytes(b"")
    run(pairs, recipe, RectifiedMatcher(), directory / "work")
    return pairs


def empty_store(work_dir: Path, pairs: list[Pair], **about: object) -> Store:
    store = Store.open(work_dir)
    rows = [
        PublishedPair(number, pair.id, pair.group, *pair.names) for number, pair in enumerate(pairs)
    ]
    facts = About({**THREE_UNITS.table(), "name": "three"}, **about)
    store.put([PublishedRun(about=facts, rows=len(pairs), pairs=len(pairs)), *rows])
    return store


def test_a_run_exports_tables_that_a_reader_of_csv_files_understands(tmp_path, capsys):
    pairs = a_run(tmp_path)
    assert run_command("journal", tmp_path / "work", "--csv", tmp_path / "csv") == 0
    tables = {}
    for path in map(Path, capsys.readouterr().out.splitlines()):
        with path.open(encoding="utf-8", newline="") as stream:
            tables[path.stem] = [*csv.DictReader(stream)]
    assert [row["pair"] for row in tables["pairs"]] == [pair.id for pair in pairs]
    assert "the file is empty" in tables["pairs"][1]["failure"]
    log = read_log(tmp_path / "work")
    written = matrices_of(log.tables.pairs)
    for number, row in enumerate(tables["pairs"]):
        F = [float(row[f"f{i}{j}"]) for i in "123" for j in "123"]
        assert written[number].ravel().tolist() == F
        inliers = [int(unit["inliers"]) for unit in tables["units"] if unit["pair"] == row["pair"]]
        assert sum(inliers) == int(row["inliers"])
        known = log.tables.pairs.loc[number]
        assert (row["image1"], row["overlaps"]) == (known["image1"], str(known["overlaps"]))
    # A row without matches is a valid F, too.
    assert np.linalg.matrix_rank(written[1]) == 2, "the fallback"
    assert len(tables["units"]) == 3 * 11
    assert len(tables["regions"]) == 2 * 11
    assert run_command("journal", tmp_path / "work", "--csv", tmp_path / "csv") == 0, (
        "its own are replaced"
    )
    capsys.readouterr()
    assert run_command("journal", tmp_path / "work") == 0
    out = capsys.readouterr().out
    assert re.search("complete after .*: 11 of 12 pairs with an F", out)
    assert "the file is empty" in out
    assert len(out.splitlines()) < 20
    # A resumed run is a second session
    run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    kinds = [event.kind for event in read_log(tmp_path / "work").events]
    assert [kind for kind in kinds if kind in ("start", "end")] == ["start", "end"]


def test_an_export_that_cannot_be_written_is_refused(tmp_path, capsys):
    empty_store(tmp_path, []).close()
    (tmp_path / "file").touch()
    assert run_command("journal", tmp_path, "--csv", tmp_path / "file" / "x") == 2
    assert "cannot be written" in capsys.readouterr().err
    assert run_command("journal", tmp_path / "none", "--report", tmp_path / "x") == 2
    assert "has no journal.sqlite" in capsys.readouterr().err


MINE = {
    "a table": lambda path: path.write_text("mine"),
    "a link to the journal": lambda path: path.symlink_to("../journal.sqlite"),
    # A write through it would make the file.
    "a link to nothing": lambda path: path.symlink_to("nothing"),
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a pipe": os.mkfifo,
    "a directory": Path.mkdir,
}


@pytest.mark.parametrize("make", MINE.values(), ids=MINE)
def test_an_export_replaces_nothing_but_its_own_tables(tmp_path, make, capsys):
    empty_store(tmp_path, []).close()
    (tmp_path / "csv").mkdir()
    make(tmp_path / "csv" / "units.csv")
    assert run_command("journal", tmp_path, "--csv", tmp_path / "csv") == 2
    assert "units.csv exists and is another table" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "csv").iterdir()] == ["units.csv"]
    assert len(read_log(tmp_path).tables.pairs) == 0


def test_the_page_begins_with_the_verdict_has_pictures_inside_and_asks_for_nothing(tmp_path):
    pairs = a_run(tmp_path)
    page = tmp_path / "new" / "report.html"
    assert report_run(tmp_path / "work", page, inf, pairs) == f"report: {page}"
    text = page.read_text(encoding="utf-8")
    assert re.search("<h1>Complete after .*: 11 of 12 pairs with an F</h1>", text)
    # A run without scenes has no section on them.
    titles = [
        "Missing results",
        "The weakest pairs",
        "Pairs",
        "Where the time went",
        "Versions",
    ]
    assert re.findall("<h2>(.*?)</h2>", text) == titles
    # The pair that was not read has no picture.
    assert text.count("<img ") == 11, "the pairs with an F"
    assert "With the fallback: 1 pair; the reasons are below." in text
    assert re.findall("<script[^>]*>", text) == ["<script>", "<script>"], "both inside the page"
    assert all(
        source.startswith("data:image/")
        for source in re.findall(r"\b(?:src|href)\s*=\s*.(\S*)", text)
    )
    assert not re.search(r"url\(|@import", text)
    assert "the file is empty" in text
    assert "Drawings are missing" not in text
    # Their inliers are not stored, and are those of the run.
    weakest = read_log(tmp_path / "work").weakest
    assert len(weakest) == 11
    pairs = read_log(tmp_path / "work").tables.pairs
    for number, match in weakest:
        found = [len(match.matches), match.estimate.inlier_count]
        assert pairs[["matches", "inliers"]].loc[number].tolist() == found
        within = sampson_distances(match.estimate.matrix, match.matches) < RobustConfig.threshold
        assert np.array_equal(match.estimate.inliers, within)


def test_drawn_inliers_are_those_of_the_run_whatever_the_unit_of_the_threshold(tmp_path):
    # In pixels of the image resized to 4,000 pixels: a tenth of a stored pixel, and less
    magsac = replace(THREE_UNITS.magsac, threshold_side=4000)
    a_run(tmp_path, recipe=replace(THREE_UNITS, magsac=magsac))
    log = read_log(tmp_path / "work")
    drawn = {number: match.estimate.inlier_count for number, match in log.weakest}
    assert drawn == log.tables.pairs["inliers"][list(drawn)].to_dict()
    assert sum(drawn.values()) > 0


def test_the_summary_has_the_facts_of_the_page_for_programs(tmp_path):
    pairs = a_run(tmp_path)
    report_run(tmp_path / "work", tmp_path / "report.html", inf, pairs)
    table = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert table["format"] == "mkpc summary 1"
    assert table["verdict"].startswith("11 of 12 pairs with an F; with the fallback: 1 pair")
    assert (table["pairs"]["count"], table["pairs"]["with_f"]) == (12, 11)
    assert table["pairs"]["sources"] == {"fallback": 1, "pair": 11}
    found = read_log(tmp_path / "work").tables.pairs.query("source != 'fallback'")
    assert table["pairs"]["inliers_minimum"] == found["inliers"].min()
    assert sum(table["pairs"]["inliers_histogram"].values()) == 12
    assert [unit["pairs"] for unit in table["units"]] == [11, 11, 11]


@pytest.mark.parametrize("make", MINE.values(), ids=MINE)
def test_a_summary_replaces_nothing_but_a_summary(tmp_path, make):
    empty_store(tmp_path, []).close()
    make(tmp_path / "page.summary.json")
    # Not what it contains: a pipe has no content to read.
    before = os.lstat(tmp_path / "page.summary.json")
    identity = before.st_ino, before.st_mtime_ns
    assert run_command("journal", tmp_path, "--report", tmp_path / "page.html") == 2
    after = os.lstat(tmp_path / "page.summary.json")
    assert (after.st_ino, after.st_mtime_ns) == identity
    assert len(read_log(tmp_path).tables.pairs) == 0


def test_text_from_files_is_escaped(tmp_path):
    pairs = [Pair(EVIL, EVIL, f"{EVIL.replace('/', '')}.png", "b.png")]
    with empty_store(
        tmp_path, pairs, device=EVIL, left_out=(EVIL,), versions={EVIL: EVIL}
    ) as store:
        for kind in EventKind:
            append_event(store.directory, Event(1.0, kind, EVIL))
    log = read_log(tmp_path)
    # With and without paths of images
    for known in ((), pairs):
        text = report_page(log, known)
        assert EVIL not in text
        assert text.count("<script") == 2, "the page's own"
        assert "&lt;script&gt;" in text
    assert EVIL in overview(log)


def test_without_matplotlib_the_page_has_tables_and_says_so(tmp_path, monkeypatch):
    pairs = a_run(tmp_path, 4)
    # The images of the first pair alone are removed.
    kept = {image for pair in pairs[1:] for image in pair.images}
    for path in set(pairs[0].images) - kept:
        path.unlink()
    assert "an image cannot be read any more" in report_page(read_log(tmp_path / "work"), pairs)
    # Python then finds no such module.
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    text = report_page(read_log(tmp_path / "work"), pairs)
    assert "matplotlib is not installed" in text
    assert "<img" not in text
    assert pairs[0].id in text


@needs_browser
@pytest.mark.parametrize("width", [1280, 400])
def test_the_table_of_pairs_sorts_and_filters_and_pictures_enlarge(tmp_path, width):
    pairs = a_run(tmp_path, 6)
    page = tmp_path / "report.html"
    report_run(tmp_path / "work", page, inf, pairs)
    rows = "[...document.querySelectorAll('table.sortable tbody tr')]"
    with opened_browser() as browser:
        browser.open(page, width)
        # The second click turns the order round.
        for kind in ("ascending", "descending"):
            browser.value("document.querySelectorAll('table.sortable th button')[2].click()")
            inliers = browser.value(f"{rows}.map((row) => Number(row.cells[2].textContent))")
            assert inliers == sorted(inliers, reverse=kind == "descending")
            assert (
                browser.value("document.querySelectorAll('table.sortable th')[2].ariaSort") == kind
            )
        # Words in any case and order
        filled = "document.querySelector('input[type=search]')"
        browser.value(f"{filled}.value = 'FALLBACK {pairs[1].id}'; {filled}.oninput()")
        shown = browser.value(
            f"{rows}.filter((row) => !row.hidden).map((row) => row.cells[0].textContent)"
        )
        assert shown == [pairs[1].id]
        browser.value("document.querySelector('figure img').click()")
        assert browser.value("document.querySelector('dialog').open")
        assert browser.value("document.querySelector('dialog img').naturalWidth") > 100
        browser.value("document.querySelector('dialog').click()")
        assert not browser.value("document.querySelector('dialog').open")
        # Tables may be wider than the window in a frame that scrolls.
        every = "[...document.querySelectorAll('body *')]"
        wide = f"{every}.filter((e) => e.getBoundingClientRect().right > innerWidth)"
        outside = f"{wide}.filter((e) => !e.closest('.wide, .rows')).map((e) => e.outerHTML.slice(0, 200))"
        assert browser.value(outside) == []
        assert browser.value("document.documentElement.scrollWidth") <= width
        assert browser.errors == []


def test_with_little_time_the_report_has_no_drawings_and_with_less_it_is_not_written(
    tmp_path, monkeypatch
):
    # At time 0, so that the end of the time is the time left
    monkeypatch.setattr("mkpc_kaggle.reporting.report.time", SimpleNamespace(monotonic=lambda: 0.0))
    pairs = a_run(tmp_path, 3)
    path = tmp_path / "report.html"
    line = report_run(tmp_path / "work", path, -0.1, pairs)
    assert line.startswith("no report, the time is up")
    assert not path.exists()
    assert report_run(tmp_path / "work", path, DRAWING_S - 1, pairs) == f"report: {path}"
    text = path.read_text()
    assert "little time was left" in text
    assert "<img" not in text


def test_a_report_that_fails_is_a_line_and_leaves_the_page_without_drawings(tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    line = report_run(tmp_path / "nowhere", path, inf)
    assert line.startswith("warning: no report, or a report without drawings (")
    pairs = a_run(tmp_path, 3)
    monkeypatch.setattr("mkpc_kaggle.reporting.report.draw_strip", None)
    assert report_run(tmp_path / "work", path, inf, pairs).startswith("warning: no report, or")
    assert "Drawings are missing" in path.read_text()


def test_the_command_draws_a_page_with_the_images_of_a_test_side(tmp_path):
    pairs = write_pairs(tmp_path / "test_images" / "set", 2)
    rows = [f"{pair.id},set,{pair.images[0].stem},{pair.images[1].stem}" for pair in pairs]
    (tmp_path / "test.csv").write_text(
        "\n".join(["sample_id,batch_id,image_1_id,image_2_id", *rows])
    )
    run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    page = tmp_path / "report.html"
    for more, told in (["--test-dir", tmp_path], "<img"), ([], "where the images are is not known"):
        assert run_command("journal", tmp_path / "work", "--report", page, *more) == 0
        assert told in page.read_text()


def test_a_doubtful_pair_and_one_without_an_f_are_marked():
    described = [
        Described("sound", source="pair", support=99.0),
        Described("doubtful", source="pair", support=3.0),
        Described("failed", failure="too few", support=99.0),
    ]
    pairs = tables_of(*described).pairs
    doubt = "3.0 times the inliers by chance"
    assert remarks(pairs) == ["", doubt, "too few"]
    assert [row[-1] for row in pair_rows(pairs)] == remarks(pairs)
