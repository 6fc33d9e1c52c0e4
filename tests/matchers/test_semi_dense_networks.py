"""What must hold of LoFTR, QuadTree and ASpanFormer with any weights."""

import pytest
import torch
from semi_dense import check_empty, random_network, textured

from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
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
