"""What must hold of LoFTR, QuadTree and ASpanFormer with any weights."""

import pytest
import torch
from semi_dense import check_empty, random_network, textured

from mkpc_kaggle.matchers.networks.adaptive_span import CELLS_AT_ONCE, span_attention
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.coarse_matching import coarse_matches
from mkpc_kaggle.matchers.networks.grids import as_map, to_2x2_blocks
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.quadtree import Quadtree


class SharpLoftr(Loftr):
    similarity_scale = 1 / (256 * 0.03)


class SharpQuadtree(Quadtree):
    similarity_scale = 1 / (256 * 0.03)


MAKERS = {
    "loftr": lambda border: SharpLoftr(0.0, border),
    "quadtree": lambda border: SharpQuadtree(0.0, border, (3, 2)),
    "aspanformer": lambda border: AspanFormer(0.0, border),
}


@pytest.fixture(params=MAKERS)
def network(request):
    """A function that makes the network, with a border of so many cells."""
    return lambda border: random_network(lambda: MAKERS[request.param](border))


@torch.inference_mode()
def test_no_point_lies_on_padding_nor_within_the_border_of_the_content(network):
    network, (h, w) = network(1), (12, 8)
    maps = [network.encode(textured(1, 1, 8 * h, 8 * w))] * 2
    masks = [torch.zeros(1, h, w, dtype=torch.bool) for _ in maps]
    masks[0][:, : h - 3, : w - 2], masks[1][:, : h - 1, : w - 4] = True, True
    matches = network.match(*maps, tuple(masks))
    assert len(matches.points0) > 0
    for cells, mask in zip((matches.coarse.cell0, matches.coarse.cell1), masks, strict=True):
        extent = mask[0].any(1).sum(), mask[0].any(0).sum()
        for position, length in zip((cells // w, cells % w), extent, strict=True):
            assert network.border <= position.min() and position.max() < length - network.border
    check_empty(network.match(*maps, (masks[0], torch.zeros_like(masks[1]))))


@torch.inference_mode()
def test_tiny_pictures_match_nothing_and_sides_must_fit(network):
    network = network(2)
    check_empty(network.match(*(network.encode(textured(1, 1, 32, width)) for width in (32, 64))))
    with pytest.raises(ValueError, match=f"multiples of {network.multiple}"):
        network.encode(torch.zeros(1, 1, 32, 36))


@pytest.mark.parametrize("held", [0, 2**20])
def test_matches_are_the_mutual_maxima_of_both_softmaxes(monkeypatch, held):
    monkeypatch.setattr("mkpc_kaggle.matchers.networks.coarse_matching.ROWS_AT_ONCE", {"cpu": 7})
    monkeypatch.setattr("mkpc_kaggle.matchers.networks.coarse_matching.HELD_FLOATS", held)
    generator = torch.Generator().manual_seed(0)
    grid0, grid1 = (torch.randn(2, 5, width, 16, generator=generator) for width in (6, 7))
    matches = coarse_matches(grid0, grid1, 0.5, 0.02, 0, None)
    similarity = (grid0.flatten(1, 2).double() @ grid1.flatten(1, 2).double().mT) * 0.5
    confidence = similarity.softmax(1) * similarity.softmax(2)
    mutual = (confidence == confidence.amax(1, keepdim=True)) & (confidence == confidence.amax(2, keepdim=True))
    expected = (mutual & (confidence > 0.02)).nonzero()
    torch.testing.assert_close(torch.stack([matches.batch, matches.cell0, matches.cell1], dim=1), expected)
    torch.testing.assert_close(matches.confidence.double(), confidence[tuple(expected.T)], rtol=1e-5, atol=0)


def test_span_attention_is_that_of_sampled_keys(monkeypatch):
    """Against grid_sample, with samples far outside and a batch, in several chunks."""
    monkeypatch.setitem(CELLS_AT_ONCE, "cpu", 5)
    generator = torch.Generator().manual_seed(0)
    q = torch.randn(2, 4, 6, 16, generator=generator)
    k, v = torch.randn(2, 2, 5, 7, 16, generator=generator)
    samples = torch.rand(2, 6, 64, 2, generator=generator) * 30 - 10
    samples[0, 0, 0] = 1e12
    usable = torch.rand(2, 6, 64, generator=generator) > 0.3
    usable[1, 2] = False
    relative = 2 * samples / torch.tensor([7.0, 5.0]) - 1
    read = [torch.nn.functional.grid_sample(as_map(x), relative, align_corners=False) for x in (k, v)]
    key, value = (x.permute(0, 2, 3, 1).unflatten(3, (2, 8)) for x in read)  # (N, cells, 64, heads, 8)
    query = to_2x2_blocks(q).unflatten(3, (2, 8))  # (N, cells, 4, heads, 8)
    for mask in (None, usable):
        logits = torch.einsum("npqhd,npshd->nphqs", query, key) / 8**0.5
        if mask is not None:
            logits = logits.masked_fill(~mask[:, :, None, None], -1e8)
        expected = torch.einsum("nphqs,npshd->npqhd", logits.softmax(-1), value).reshape(q.shape)
        torch.testing.assert_close(span_attention(q, k, v, samples, 2, mask), expected, rtol=1e-4, atol=1e-5)
