"""Wrong focal lengths of EXIF: a start without them is tried where cameras are missing or doubtful."""

from dataclasses import replace

import pytest

from benchmarks.synthetic_scene import synthetic_scene
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene import colmap
from mkpc_kaggle.scene.models import FocalSource, models_of
from mkpc_kaggle.scene.sfm import reconstruct_graph
from mkpc_kaggle.scene.view_graph import BatchPair, ViewGraph

FOCAL = 840.0
SCENE = synthetic_scene(6, points=500, focals=[FOCAL] * 6)


def pairs_with_exif(factor: float) -> list[BatchPair]:
    """Return the pairs; EXIF has the true focal length times a factor."""
    pairs = []
    for pair in SCENE.pairs:
        image0 = replace(pair.image0, focal=factor * FOCAL)
        image1 = replace(pair.image1, focal=factor * FOCAL)
        pairs.append(replace(pair, image0=image0, image1=image1))
    return pairs


@pytest.fixture
def mappings(monkeypatch) -> list[bool]:
    """For each run of the global mapper, whether cameras started with EXIF."""
    starts = []
    run = colmap.run_mapper

    def noted(database, graph, config):
        starts.append(graph.uses_exif)
        return run(database, graph, config)

    monkeypatch.setattr(colmap, "run_mapper", noted)
    return starts


# With 0.3, four of six cameras were placed, without sigmas; with 6, none.
@pytest.mark.parametrize("factor", [0.3, 6.0])
def test_all_cameras_are_found_in_spite_of_a_wrong_exif_and_it_is_named(mappings, factor):
    graph = ViewGraph.of_pairs(pairs_with_exif(factor))
    found, _ = reconstruct_graph(graph, SceneConfig())
    (model,) = models_of(found)
    assert len(model.images) == 6
    assert mappings == [True, False]
    for each in model.images:
        assert each.focal == pytest.approx(FOCAL, rel=0.01)
    (focal,) = model.comparison.focals
    assert focal.source is FocalSource.EXIF
    assert focal.given == pytest.approx(factor * FOCAL)


def test_a_right_exif_is_tried_alone(mappings):
    found, _ = reconstruct_graph(ViewGraph.of_pairs(pairs_with_exif(1.0)), SceneConfig())
    assert found[0].registered == 6
    assert mappings == [True]
