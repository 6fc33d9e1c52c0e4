"""The summary of a run on the terminal, and the command ``journal``."""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rectified import THREE_UNITS, RectifiedMatcher, run, write_pairs
from run_tables import UNIT, Described, tables_of
from shared import run_command

from mkpc_kaggle.engine.frames import Results
from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.recipe import load_recipe
from mkpc_kaggle.reporting.summary import left_out_line, summary, trouble, unit_table
from mkpc_kaggle.scene.models import Reconstruction, RegisteredImage, SfmModel
from mkpc_kaggle.scene.records import NOT_RECONSTRUCTED, SceneRecord
from mkpc_kaggle.scene.view_graph import BatchImage

# As a run leaves a pair that it had no time for
UNREACHED = Described(failure=None)


def scene(*names: str, **fields: object) -> SceneRecord:
    pose = Camera(np.eye(3), np.eye(3), np.zeros(3))
    images = [
        RegisteredImage(BatchImage(name, name, Size(80, 60)), pose, 50) for name in names
    ]
    models = (SfmModel(tuple(images), np.zeros((0, 3)), 0.5),) if names else ()
    record = SceneRecord.of("batch", [Reconstruction(names, models)], key="scene of batch")
    return replace(record, **fields)


def report(
    ending: Ending,
    *pairs: Described,
    faults: Sequence[str] = (),
    **more: Any,
) -> Results:
    found = tables_of(*pairs, **more)
    about = replace(found.about, ending=ending, seconds=60.0, faults=faults)
    return replace(found, about=about)


def test_sources_of_f_are_counted():
    scene = Described(source="scene", matches=200, inliers=100)
    done = Described(source="pair", matches=200, inliers=100)
    text = summary(report(Ending.INTERRUPTED, scene, done, UNREACHED))
    assert text.startswith("interrupted after 1m00s: 2 of 3 pairs with an F; 0 units run")
    assert "F: 1 from cameras, 1 from their own matches, 1 the fallback" in text
    assert text.endswith("1 pair left; run the same command to continue")


def test_the_means_of_a_unit_leave_out_the_pairs_on_which_it_failed():
    done = Described(matches=200, inliers=100, seconds=2.0)
    failed = Described(error="KeyError: 'x'")
    table = unit_table(tables_of(failed, done, failed).units)
    assert table.loc[UNIT].tolist() == [1, 200.0, 100.0, 2.0]


def test_an_interrupted_run_says_how_to_continue_and_lists_no_failures():
    pending = scene(failure=NOT_RECONSTRUCTED, key="")
    text = summary(report(Ending.INTERRUPTED, UNREACHED, UNREACHED, scenes=(pending,)))
    assert text.endswith("2 pairs left; 1 batch left; run the same command to continue")
    assert "not reached" not in text
    assert NOT_RECONSTRUCTED not in text


def test_images_of_a_folder_without_a_camera_are_named():
    files = {"batch": ["a", "copy of a", "b", "c", "d", "e"]}
    digests = {"a": "a", "copy of a": "a", "b": "b"}
    pairs = [Described(images=("a", "copy of a")), Described(images=("a", "b"))]
    found = report(
        Ending.COMPLETE, *pairs, scenes=(scene("a"),), files=files, digests=digests
    )
    text = summary(found)
    # Identical files share a camera.
    assert "2 of 6 images with a camera" in text
    assert "batch: no camera for b, c, d and 1 more" in text


def test_a_summary_with_all_kinds_of_failures_is_one_screen():
    pairs = [Described(error=f"error {number}") for number in range(30)]
    scenes = tuple(
        replace(scene("a", "b", "c"), batch=f"batch {n}", key=f"scene {n}") for n in range(30)
    )
    text = summary(report(Ending.COMPLETE, *pairs, scenes=scenes, faults=("x", "y", "z")))
    lines = text.splitlines()
    assert len(lines) <= 13  # and then the submission and the page
    assert re.fullmatch(r"\.\.\. and \d+ more in the report", lines[-2])
    assert lines[-1].startswith("the run failed: 30 of 30 pairs got no F because of errors")


@pytest.mark.parametrize(("failed", "fails"), [(1, False), (3, True)])
def test_a_run_fails_if_errors_left_most_pairs_without_an_f(failed, fails):
    pairs = [Described(error="KeyError: 'x'")] * failed
    pairs += [Described(source="pair", matches=20, inliers=10)] * 2
    assert bool(trouble(report(Ending.COMPLETE, *pairs))) == fails
    # Few matches are no error.
    few = [Described(failure="too few distinct matches", matches=3)] * 3
    assert trouble(report(Ending.COMPLETE, *few)) == ""


def test_without_weights_the_line_names_the_whole_way_to_learned_matchers():
    recipe = load_recipe("classical")
    line = left_out_line(recipe, ["aliked", "loma"])
    assert line.startswith("RootSIFT only; ")
    assert "`mkpc weights fetch light --out weights`" in line
    assert "`--weights weights`" in line
    # It was done, and another matcher is missing.
    more = left_out_line(load_recipe("light"), ["loma"])
    assert more == "left out, no weights: loma"


def test_the_journal_shows_how_far_a_run_is(tmp_path, capsys):
    pairs = write_pairs(tmp_path / "images", 4)
    pairs[1].images[1].write_bytes(b"")
    run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work")
    assert run_command("journal", tmp_path / "work") == 0
    out = capsys.readouterr().out
    assert re.search("complete after .*: 3 of 4 pairs with an F", out)
    assert "the file is empty" in out
    assert run_command("journal", tmp_path / "none") == 2
    assert "has no journal.sqlite" in capsys.readouterr().err
