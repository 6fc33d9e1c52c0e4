"""Extra pairs: their choice, and their effect on a run."""

from dataclasses import replace
from itertools import combinations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from pandas.testing import assert_frame_equal
from rectified import run, sources
from run_tables import matrices_of
from synthetic import RECIPE, SyntheticMatcher, synthetic_pairs

from mkpc_kaggle.engine.frames import results
from mkpc_kaggle.engine.request import Ending
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.recipe import SceneConfig
from mkpc_kaggle.scene.densify import extra_pairs

# Each of six images with the next only.
CHAIN = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]


@given(st.integers(2, 12), st.floats(0, 8), st.integers(0, 2**32 - 1))
def test_a_batch_gets_as_many_pairs_as_it_lacks_and_none_twice(images, wanted, seed):
    rng = np.random.default_rng(seed)
    every = list(combinations(range(images), 2))
    known = []
    asked = []
    for first, second in every:
        # About 40 % of the pairs, so that few and many wanted pairs are missing.
        if rng.random() < 0.4:
            known.append((first, second))
            # A test set has pairs in either order.
            is_swapped = rng.random() < 0.5
            asked.append((second, first) if is_swapped else (first, second))
    chosen = extra_pairs(images, asked, wanted)
    assert len(set(chosen)) == len(chosen)
    assert set(chosen) <= set(every) - set(known)
    # Each pair of images exists once, so small batches cannot have all wanted pairs.
    total = min(int(np.ceil(wanted * images)), len(every))
    assert len(chosen) == max(0, total - len(known))


def test_images_in_few_pairs_come_first_and_get_partners_that_have_the_same_partners():
    # Six images at 1 pair an image: one more than the five of the chain.
    assert extra_pairs(6, CHAIN, 1) == [(0, 2)], "0 and 2 have 1 in common"
    # At 1.5, the four more pairs suffice for a second partner of both ends.
    pairs = [*CHAIN, *extra_pairs(6, CHAIN, 1.5)]
    partners = np.bincount(np.ravel(pairs))
    assert partners.min() >= 2
    assert extra_pairs(6, CHAIN, 0) == []


def test_a_sparse_batch_has_a_scene_by_pairs_that_no_row_names(tmp_path):
    work = tmp_path / "work"
    every = synthetic_pairs(tmp_path / "images")
    matcher = SyntheticMatcher()
    # The mapper needs pairs across the chain.
    order = list(combinations(range(6), 2))
    indices = [order.index(ends) for ends in CHAIN]
    asked = [every[index] for index in indices]
    recipe = replace(RECIPE, scene=SceneConfig(pairs_per_image=2))
    published: list[int] = []

    def publish(standing: State) -> None:
        published.append(len(standing.written[1]))

    report = run(asked, recipe, matcher, work, publish=publish)
    assert report.ending is Ending.COMPLETE
    assert sources(report) == ["scene"] * 5
    true_pairs = [matcher.scene.pairs[index] for index in indices]
    for F, pair in zip(matrices_of(report.pairs), true_pairs, strict=True):
        assert matcher.scene.median_distance(F, pair) < 0.5
    assert len(matcher.calls) == 12, "two pairs an image"
    # Extra pairs are in no result, table or report.
    assert set(published) == {5}
    assert len(results(work).pairs) == 5
    again = run(asked, recipe, SyntheticMatcher(), work)
    assert_frame_equal(again.scenes, report.scenes)
