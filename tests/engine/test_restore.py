"""What a run begins with: results of today, and no others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rectified import SECOND, SWEEP, THIRD
from run_tables import matrices_of
from store_room import CAMERA, RECIPE, REGIONS, F, Room, matches_of, pair_of

from mkpc_kaggle.engine.frames import (
    NOT_REACHED,
    results_of,
)
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.geometry.critical_region import When
from mkpc_kaggle.geometry.crop_need import CropNeed
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL


def test_stored_results_are_read_after_reopening(whole: Room, tmp_path: Path) -> None:
    before = results_of(whole.store)
    whole.store.close()
    with Store.open(tmp_path) as again:
        found = results_of(again)
    pairs = found.pairs
    assert pairs["source"].tolist() == ["scene", "pair", "fallback"]
    assert pairs["failure"].tolist() == ["", "", NOT_REACHED]
    assert pairs["error"].tolist() == [""] * 3
    units = found.units[found.units["pair"] == "p1"][["unit", "matches", "inliers"]]
    assert units.to_numpy().tolist() == [[SWEEP.name, 30, 7], [SECOND.name, 30, 8]]
    assert np.array_equal(matrices_of(pairs)[0], 3 * F)
    assert pairs["magsac"][0] == (2 * F).ravel().tolist()
    assert found.units.equals(before.units)
    assert found.scenes.equals(before.scenes)
    assert found.scenes.loc[0, ["cameras", "reprojection_error"]].tolist() == [2, 0.7]
    assert found.points["one", 0].tolist() == [[0.0, 0.0, 5.0]]
    cameras = found.cameras.to_dict("records")
    assert [camera["image"] for camera in cameras] == ["0.png", "1.png"]
    for camera in cameras:
        for part in ("K", "R", "t"):
            assert np.array_equal(camera[part], getattr(CAMERA, part))
    (match,) = found.matches("p0")
    assert match.regions == REGIONS
    assert np.array_equal(match.estimate.matrix, F)
    assert match.results[0].matches.to_bytes() == matches_of(0).to_bytes()


SECOND_360 = replace(SECOND, long_side=360)


FOUR = [pair_of(number) for number in range(4)]


# A change, then the number of pairs with points in use, the number of pairs whose estimate is up to
# date, and whether the scene is
CHANGES = {
    "nothing": (lambda room: room.ask(), (2, 2, True)),
    "unit added": (
        lambda room: room.ask(replace(RECIPE, units=(SWEEP, SECOND, SECOND_360))),
        (2, 2, True),
    ),
    "unit removed": (lambda room: room.ask(replace(RECIPE, units=(SWEEP,))), (2, 0, False)),
    "threshold": (lambda room: room.ask(estimate="other"), (2, 0, False)),
    "scene": (lambda room: room.ask(scene="other"), (2, 2, False)),
    "crops": (lambda room: room.ask(mkpc="other"), (2, 0, False)),
    "pair added": (lambda room: room.ask(pairs=FOUR), (2, 2, True)),
    "content": (lambda room: room.ask(contents={"0.png": "new"}), (1, 1, False)),
    "content of second images": (
        lambda room: room.ask(contents={"c.png": "new"}),
        (0, 0, False),
    ),
    "more points": (lambda room: room.match(2, SWEEP), (3, 2, False)),
}


@pytest.mark.parametrize(("change", "standing"), CHANGES.values(), ids=CHANGES)
def test_a_result_is_up_to_date_if_it_is_stored_under_todays_key(
    whole: Room, change, standing
) -> None:
    change(whole)
    assert whole.standing == standing
    # The former settings have their results again.
    whole.ask(pairs=FOUR[:3])
    assert whole.standing == (2, 2, True) or change is CHANGES["more points"][0]


def test_a_later_unit_of_stage_1_changes_no_crop_and_one_that_comes_late_opens_it_again(
    room: Room,
) -> None:
    room.ask(replace(RECIPE, units=(SWEEP, SECOND, THIRD)))
    room.match(0, SWEEP, SECOND)
    room.match(0, THIRD)
    assert room.state.done[0].all()
    # A unit before the crop, which was given up, and then forgiven
    room.ask(replace(RECIPE, units=(SWEEP, THIRD, SECOND)))
    assert room.state.done[0].tolist() == [True, True, False]
    room.match(1, SWEEP)
    room.match(1, SECOND)
    room.match(1, THIRD)
    assert room.state.done[1].tolist() == [True, True, False]


def test_a_crop_that_the_pair_does_not_need_is_judged_again_by_todays_rule(
    room: Room,
) -> None:
    def ask(least: float) -> tuple[bool, bool]:
        mkpc = replace(RECIPE.mkpc, when=When.SCALE, min_scale=least)
        room.ask(replace(RECIPE, mkpc=mkpc))
        return bool(room.state.done[0, 1]), bool(room.state.used[0, 1])

    ask(3.0)
    room.match(0, SWEEP)
    room.match(0, SECOND, need=CropNeed(False, 2.0, 1.0))
    assert ask(3.0) == (True, False)
    without = room.state.estimate_key(0)
    assert ask(1.5) == (False, False), "it was not computed"
    room.match(0, SECOND, need=CropNeed(True, 2.0, 1.0))
    assert ask(1.5) == (True, True)
    assert ask(3.0) == (True, False)
    assert room.state.estimate_key(0) == without


def test_reports_show_the_f_that_was_written_last_and_decide_nothing_themselves(
    whole: Room,
) -> None:
    # Stored, but not in the submission yet: the report must agree with the file.
    whole.match(2, SWEEP)
    whole.estimate(2)
    pairs = results_of(whole.store).pairs
    assert pairs[["source", "units"]].loc[2].tolist() == ["fallback", 0]
    assert np.array_equal(matrices_of(pairs)[2], FALLBACK_FUNDAMENTAL)
    whole.publish()
    pairs = results_of(whole.store).pairs
    assert pairs[["source", "units"]].loc[2].tolist() == ["pair", 1]
    assert np.array_equal(matrices_of(pairs)[2], F)


def test_rows_of_the_same_images_share_their_points_and_turned_images_are_others(
    room: Room,
) -> None:
    pairs = [pair_of(0), pair_of(1), replace(pair_of(0), id="again")]
    room.ask(pairs=pairs)
    assert len(room.state.pairs) == 2
    room.match(0, SWEEP)
    room.estimate(0)
    room.publish()
    rows = results_of(room.store).pairs
    assert rows["pair"].tolist() == ["p0", "p1", "again"]
    assert rows["source"].tolist() == ["pair", "fallback", "pair"]
    room.ask(pairs=[replace(pairs[0], turns=(1, 0))])
    assert not room.state.done.any()


def test_a_batch_under_another_name_keeps_its_scene(whole: Room) -> None:
    whole.ask(pairs=[replace(pair_of(number), group="renamed") for number in range(3)])
    assert list(whole.state.scenes) == ["renamed"]
    whole.publish()
    assert set(results_of(whole.store).cameras["batch"]) == {"renamed"}
