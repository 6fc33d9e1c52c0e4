"""The scores of lists of pairs in benchmarks.paper_tables, against an independent evaluation."""

import time
from dataclasses import replace
from math import isfinite

import numpy as np
import pytest
from pair_lists import line_of_pair
from protocol_by_hand import auc, evaluate
from scipy.spatial.transform import Rotation
from shared import DATA, needs_data, write_recipe

from benchmarks.lists import read_pairs
from benchmarks.paper_tables import largest_side, scores_of_list
from mkpc_kaggle.data.competition import read_train_side
from mkpc_kaggle.data.images import read_image
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.frames import results
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.metrics import pose_auc
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.recipe import load_recipe
from mkpc_kaggle.signals import Interrupt

OUTDOORS = ["castle_p19", "fountain_p11", "herz_jesus_p8", "reichstag_26"]


def precise(camera: Camera) -> Camera:
    """The camera with a rotation of all digits: with six, the angle from a trace is wrong by up to
    0.1 degrees.
    """
    return replace(camera, R=Rotation.from_matrix(camera.R).as_matrix())


@needs_data
@pytest.mark.parametrize(
    ("scenes", "pairs", "units"),
    # One unit as in SuperGlue's ScanNet evaluation, and several sizes with crops as in the paper.
    [
        (["scannet_samples"], 8, [(1, 640)]),
        (OUTDOORS, 1, [(1, 480), (1, 640), (2, 480)]),
    ],
)
def test_an_independent_evaluation_of_the_same_matches_agrees(scenes, pairs, units, tmp_path):
    train = DATA / "train"
    lines = []
    for scene in read_train_side(train, scenes=scenes, pairs_per_scene=pairs):
        for true in scene.pairs:
            cameras = {"camera0": precise(true.camera0), "camera1": precise(true.camera1)}
            lines.append(line_of_pair(replace(true, **cameras), train))
    (tmp_path / "list.txt").write_text("\n".join(lines))
    listed = read_pairs(tmp_path / "list.txt", train)
    recipe = load_recipe(str(write_recipe(tmp_path / "recipe.toml", *units)))
    session = Session(tmp_path / "work", Budget(time.monotonic()), Interrupt(), progress=False)
    run_pairs([true.pair for true in listed.pairs], assemble(recipe), session, str(train))
    found = results(tmp_path / "work")
    side = largest_side(recipe)
    assert side == 640
    scores = scores_of_list(found, listed, "ransac", side)
    expected = []
    names = [true.pair.id for true in listed.pairs]
    for line, true, match in zip(lines, listed.pairs, found.matches(*names), strict=True):
        # In double precision, as the other evaluation reads its lists.
        points = [each.astype(float) for each in (match.matches.points0, match.matches.points1)]
        keypoints = found.units["keypoints"][found.units["pair"] == true.pair.id].sum()
        sizes = [read_image(path).size for path in true.pair.images]
        expected.append(evaluate(line, points, keypoints, sizes, side))
    by_hand = {
        "rotation": [score.error.rotation for score in scores],
        "translation": [score.error.translation_angle for score in scores],
        "precision": [score.precision for score in scores],
        "matching_score": [score.matching_score for score in scores],
    }
    for key, own in by_hand.items():
        others = [pair[key] for pair in expected]
        np.testing.assert_allclose(own, others, atol=1e-6, err_msg=key)
    errors = [max(pair["rotation"], pair["translation"]) for pair in expected]
    for limit in (5, 10, 20):
        own = pose_auc([score.error for score in scores], limit)
        assert own == pytest.approx(auc(errors, limit), abs=1e-6)
    assert any(map(isfinite, errors))
