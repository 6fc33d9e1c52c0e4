"""LoFTR, QuadTree and ASpanFormer: properties of the networks, and the matchers from public
checkpoints.
"""

import numpy as np
import pytest
import torch
from light_matchers import MATCHERS
from pictures import picture

from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.networks.adaptive_span import CELLS_AT_ONCE, span_attention
from mkpc_kaggle.matchers.networks.coarse_matching import coarse_matches


@pytest.mark.parametrize("held", [0, 2**20])
def test_matches_are_the_mutual_maxima_of_both_softmaxes(monkeypatch, held):
    # Seven of thirty rows at once: the last block is smaller.
    monkeypatch.setattr(
        "mkpc_kaggle.matchers.networks.coarse_matching.ROWS_AT_ONCE", {"cpu": 7}
    )
    monkeypatch.setattr("mkpc_kaggle.matchers.networks.coarse_matching.HELD_FLOATS", held)
    generator = torch.Generator().manual_seed(0)
    grid0 = torch.randn(5, 6, 16, generator=generator)
    grid1 = torch.randn(5, 7, 16, generator=generator)
    matches = coarse_matches(grid0, grid1, 0.5, 0.02, 0, None)
    # The whole matrix in float64, which the network never holds: it takes gigabytes.
    cells0 = grid0.flatten(0, 1).double()
    cells1 = grid1.flatten(0, 1).double()
    similarity = 0.5 * cells0 @ cells1.mT
    confidence = similarity.softmax(0) * similarity.softmax(1)
    largest_of_column = confidence == confidence.amax(0, keepdim=True)
    largest_of_row = confidence == confidence.amax(1, keepdim=True)
    is_match = largest_of_column & largest_of_row & (confidence > 0.02)
    expected = is_match.nonzero()
    found = torch.stack([matches.index0, matches.index1], dim=1)
    torch.testing.assert_close(found, expected)
    scores = confidence[tuple(expected.T)]
    torch.testing.assert_close(matches.scores.double(), scores, rtol=1e-5, atol=0)


def test_span_attention_in_chunks_is_that_of_the_whole(monkeypatch):
    """With samples far outside. Some of them are not usable."""
    generator = torch.Generator().manual_seed(0)
    q = torch.randn(2, 4, 6, 16, generator=generator)
    k, v = torch.randn(2, 2, 5, 7, 16, generator=generator)
    # Cells of the 5 x 7 grid, and far outside of it
    samples = torch.rand(2, 6, 64, 2, generator=generator) * 30 - 10
    samples[0, 0, 0] = 1e12
    usable = torch.rand(2, 6, 64, generator=generator) > 0.3
    usable[1, 2] = False  # a query without any usable sample: its softmax is 0 / 0
    for mask in (None, usable):
        whole = span_attention(q, k, v, samples, 2, mask)
        assert whole.isfinite().all()
        with monkeypatch.context() as patch:
            patch.setitem(CELLS_AT_ONCE, "cpu", 5)
            in_chunks = span_attention(q, k, v, samples, 2, mask)
            torch.testing.assert_close(in_chunks, whole, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["loftr", "quadtree", "aspanformer"])
def test_points_of_image_0_are_centres_of_cells_within_the_border_of_the_content(name):
    matcher = MATCHERS[name](Placement())
    multiple = matcher.spec.multiple
    padded = picture(97, 131, channels=1, multiple=multiple, padding=(20, 40))
    whole = picture(97, 131, channels=1, multiple=multiple)
    (first,) = matcher.encode([padded])
    (second,) = matcher.encode([whole])
    assert first.mask.sum() == 13 * 17  # cells of 8 pixels that 97 x 131 pixels touch
    (matches,) = matcher.match([first], [second])
    assert len(matches) > 0
    # An offset of half a cell would be four pixels.
    cells = (matches.points0 + 0.5) / 8
    np.testing.assert_array_equal(cells % 1, 0)
    border = matcher._network.border
    assert (cells >= border).all()
    assert (cells < np.array([17, 13]) - border).all()
