"""What must hold of LoFTR, QuadTree and ASpanFormer with any weights."""

import pytest
import torch
from semi_dense import assert_same_matches, check_empty, items_of, random_network, textured

from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.matchers.networks.resnet_fpn import FeatureMaps


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
def test_two_pairs_in_a_batch_match_as_each_does_alone_masks_included(network):
    network, sizes = network(0), ((64, 96), (96, 64))
    images = [textured(2, 1, *size, seed=seed) for seed, size in enumerate(sizes, start=1)]
    maps = [network.encode(image) for image in images]
    masks = [torch.ones(2, *(side // 8 for side in size), dtype=torch.bool) for size in sizes]
    masks[0][1, :, -4:], masks[1][0, -4:] = False, False
    both = network.match(*maps, tuple(masks))
    for item in (0, 1):
        alone = [network.encode(image[item : item + 1]) for image in images]
        single = network.match(*alone, tuple(mask[item : item + 1] for mask in masks))
        assert_same_matches(items_of(both, item), items_of(single, 0))


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


@torch.inference_mode()
def test_whatever_loftrs_padding_holds_the_content_matches_as_if_it_were_cut_out():
    small = random_network(lambda: MAKERS["loftr"](1))
    maps = [small.encode(textured(1, 1, 64, 80, seed=seed)) for seed in (1, 2)]
    padded, masks = [], []
    for features, (below, right) in zip(maps, ((3, 0), (1, 5)), strict=True):
        coarse = torch.nn.functional.pad(features.coarse, (0, right, 0, below), value=7.0)
        fine = torch.nn.functional.pad(features.fine, (0, 4 * right, 0, 4 * below), value=-3.0)
        padded.append(FeatureMaps(coarse, fine))
        masks.append(torch.nn.functional.pad(torch.ones(1, 8, 10), (0, right, 0, below)).bool())
    cropped, found = items_of(small.match(*maps), 0), items_of(small.match(*padded, tuple(masks)), 0)
    assert_same_matches(cropped[2:], found[2:])
