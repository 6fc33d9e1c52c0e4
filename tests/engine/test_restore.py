"""What a run begins with: results of today, and the F of the last table of pairs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rectified import SECOND, SWEEP, THIRD
from store_room import RECIPE, REGIONS, F, Room, matches_of, pair_of

from mkpc_kaggle.engine.estimates import Estimating
from mkpc_kaggle.engine.jobs import Cause, Estimated, Failure
from mkpc_kaggle.engine.plan.state import EARLIER, FALLBACK, PAIR, SCENE
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.dataframes import (
    NOT_REACHED,
    matrices_of,
    pair_tables,
    regions_of,
    results,
)
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.engine.store.rows import to_bytes
from mkpc_kaggle.engine.store.tables import ImageFile
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL


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
            assert image.points == other.points
            for part in ("K", "R", "t"):
                assert np.array_equal(getattr(image.camera, part), getattr(other.camera, part))
        assert units.equals(before.units)
        points = published.points_of(again, published.rows[0])
        assert to_bytes(points[SWEEP.name]) == to_bytes(matches_of(0))
        assert published.run.about.recipe == {"name": "x"}


def test_results_are_data_frames_of_pairs_units_and_cameras(whole: Room, tmp_path: Path) -> None:
    found = results(tmp_path)
    pairs, units, cameras = found.pairs, found.units, found.cameras
    assert pairs["pair"].tolist() == ["p0", "p1", "p2"]
    assert pairs["source"].tolist() == ["scene", "pair", "fallback"]
    assert pairs[["f11", "f33"]].iloc[0].tolist() == [3.0, 27.0]
    assert units.groupby("unit")["inliers"].sum().to_dict() == {SWEEP.name: 14, SECOND.name: 16}
    assert cameras[["image", "focal"]].to_numpy().tolist() == [["0.png", 500.0], ["1.png", 500.0]]
    assert cameras["points"].tolist() == [9, 9]


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
        assert not whole.state.scenes.in_use
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


def test_the_f_of_a_scene_stands_in_for_the_pairs_own_until_its_scene_is_made_again(
    whole: Room,
) -> None:
    whole.match(2, SWEEP)
    # The scene is of other points than today's. Again and again, as in runs that are interrupted.
    for _ in range(2):
        whole.ask()
        assert whole.state.scenes.stale == {"one"}
        assert whole.state.has_own.tolist() == [True, True, False]
        assert whole.state.sources.tolist() == [EARLIER, PAIR, FALLBACK]
        assert np.array_equal(whole.state.fundamentals[:2], [3 * F, F])
        whole.publish()
    # As a fresh run would write it, if no scene can be made
    whole.state.give_up(("scenes",), Failure(Cause.NOT_STARTED))
    assert whole.state.sources.tolist() == [PAIR, PAIR, FALLBACK]
    published = whole.publication.version()
    assert [row.source for row in published.rows] == ["pair", "pair", "fallback"]
    whole.ask()
    whole.reconstruct()
    assert whole.state.sources.tolist() == [SCENE, PAIR, FALLBACK]


def test_a_scene_of_today_leaves_the_earlier_f_of_pairs_that_it_does_not_know(whole: Room) -> None:
    # Near the end of a run, a scene is made of the pairs that were reached.
    before = whole.state.fundamentals
    whole.ask(replace(RECIPE, units=(THIRD,)), estimate="other", scene="other")
    whole.match(0, THIRD)
    whole.estimate(0)
    whole.reconstruct()
    assert whole.state.sources.tolist() == [SCENE, EARLIER, FALLBACK]
    assert np.array_equal(whole.state.fundamentals[1], before[1])
    # A new scene, or a stale one, brings back no F of an earlier scene for a pair with its own.
    whole.match(1, THIRD)
    whole.estimate(1)
    assert whole.state.scenes.stale == {"one"}
    assert whole.state.sources.tolist() == [SCENE, PAIR, FALLBACK]


def test_an_estimate_of_the_former_content_of_an_image_is_not_used(whole: Room) -> None:
    estimating = Estimating(whole.run)
    whole.match(2, SWEEP)
    job = estimating.job([2])
    assert job is not None
    # Its image is replaced while the worker estimates, and matched again at once.
    whole.match(2, SWEEP, digest="new")
    (pair,) = job.pairs
    answer = Estimated(tuple(pair.points.values()), (7,) * len(pair.points), F)
    estimating.save(job, [answer], 0.5)
    assert whole.state.sources[2] == FALLBACK
    whole.estimate(2)
    assert whole.state.sources[2] == PAIR


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
