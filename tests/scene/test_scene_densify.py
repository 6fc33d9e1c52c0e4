"""Extra pairs: which they are, and what a run makes of them."""

from dataclasses import replace
from itertools import combinations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from rectified import run
from synthetic import RECIPE, SyntheticMatcher, synthetic_pairs

from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.reporting.run_log import read_log
from mkpc_kaggle.scene.densify import extra_pairs

CHAIN = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]


@given(st.integers(2, 12), st.floats(0, 8), st.integers(0, 2**32 - 1))
def test_a_batch_gets_as_many_pairs_as_it_lacks_and_none_twice(images, wanted, seed):
    rng = np.random.default_rng(seed)
    every = list(combinations(range(images), 2))
    # In either order, as a test set has them
    asked = [ends if rng.random() < 0.5 else ends[::-1] for ends in every if rng.random() < 0.4]
    chosen = extra_pairs(images, asked, wanted)
    known = {(min(ends), max(ends)) for ends in asked}
    assert len(set(chosen)) == len(chosen)
    assert set(chosen) <= set(every) - known
    assert len(chosen) == max(0, min(int(np.ceil(wanted * images)), len(every)) - len(known))


def test_images_in_few_pairs_come_first_and_get_partners_that_have_the_same_partners():
    assert extra_pairs(6, CHAIN, 1) == [(0, 2)], "0 and 2 have 1 in common"
    degrees = np.bincount(np.ravel([*CHAIN, *extra_pairs(6, CHAIN, 1.5)]))
    assert degrees.min() >= 2
    assert extra_pairs(6, CHAIN, 0) == []


def test_a_sparse_batch_has_a_scene_by_pairs_that_no_row_names(tmp_path):
    every = synthetic_pairs(tmp_path / "images")
    matcher = SyntheticMatcher()
    # A chain: the mapper needs pairs across it.
    asked = [every[list(combinations(range(6), 2)).index(ends)] for ends in CHAIN]
    published: list[int] = []
    recipe = replace(RECIPE, scene=SceneConfig(pairs_per_image=2))
    publish = lambda standing: published.append(len(standing.fundamentals))  # noqa: E731
    report = run(asked, recipe, matcher, tmp_path / "work", publish=publish)
    assert report.ending is Ending.COMPLETE
    assert [record.source for record in report.records] == ["scene"] * 5
    true = [matcher.scene.pairs[list(combinations(range(6), 2)).index(ends)] for ends in CHAIN]
    found = zip(report.records, true, strict=True)
    assert (
        max(
            matcher.scene.median_distance(record.chosen_fundamental, pair) for record, pair in found
        )
        < 0.5
    )
    assert len(matcher.calls) == 12, "two pairs an image"
    # Extra pairs are in no result, table or report.
    assert set(published) == {5}
    assert len(read_log(tmp_path / "work").records) == 5
    assert run(asked, recipe, SyntheticMatcher(), tmp_path / "work").scenes == report.scenes
