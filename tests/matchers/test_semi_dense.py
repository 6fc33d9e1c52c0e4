"""LoFTR, QuadTree and ASpanFormer: properties of the networks, and the matchers from public checkpoints."""

from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from checkpoints import PublicFile, store_of, wrapped
from pictures import picture
from semi_dense import check_empty, random_network, textured
from torch import nn

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.adapters import aspanformer, loftr, quadtree
from mkpc_kaggle.matchers.contract import Picture, Placement, Training
from mkpc_kaggle.matchers.networks.adaptive_span import CELLS_AT_ONCE, span_attention
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.coarse_matching import coarse_matches
from mkpc_kaggle.matchers.networks.grids import as_map, to_2x2_blocks
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY
from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher


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


MODULES: list[tuple[ModuleType, type[nn.Module]]] = [
    (loftr, Loftr),
    (quadtree, Quadtree),
    (aspanformer, AspanFormer),
]


def load_standin(
    module: ModuleType, network: type[nn.Module], directory: Path, training: Training, **options: Any
) -> Any:
    """Return the matcher with stand-in weights for this training alone."""
    name, surplus = module.SPEC.name, options.pop("surplus", {})
    layout = partial(lambda more, state: wrapped(state | more), surplus)
    store = store_of(directory, [PublicFile("x.ckpt", name, f"{name}-{training}", name, network, layout)])
    return module.load(store, module.SPEC.options(threshold=0.0, training=training, **options), Placement())


@pytest.fixture(scope="module", params=MODULES, ids=["loftr", "quadtree", "aspanformer"])
def matcher(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> SemiDenseMatcher:
    matcher = load_standin(*request.param, tmp_path_factory.mktemp("weights"), Training.OUTDOOR)
    assert isinstance(matcher, SemiDenseMatcher)
    return matcher


def shown(height: int, width: int, matcher: SemiDenseMatcher) -> Picture:
    return picture(height, width, channels=1, multiple=matcher.spec.multiple)


def test_indoor_weights_come_with_their_settings(tmp_path: Path) -> None:
    of_loftr, of_quadtree, of_aspanformer = (
        load_standin(*kind, tmp_path, Training.INDOOR)._network for kind in MODULES
    )
    assert (of_loftr.border, of_loftr.decay) == (0, FIXED_DECAY)
    assert of_quadtree.loftr_coarse.layers[0].attn.topks == (32, 16)
    # Of the published size, so that positions are neither stretched nor shrunk.
    assert (of_aspanformer.border, of_aspanformer.position_scale(60, 80)) == (0, (1, 1))


def test_weights_with_optimal_transport_are_refused_with_what_to_take_instead(tmp_path: Path) -> None:
    surplus = {"coarse_matching.bin_score": torch.ones(())}
    with pytest.raises(UserError, match=r"'loftr-outdoor' match by optimal transport.*outdoor_ds"):
        load_standin(loftr, Loftr, tmp_path, Training.OUTDOOR, surplus=surplus)


def test_cells_on_padding_are_masked_and_points_of_image_0_are_corners_of_cells(matcher: SemiDenseMatcher) -> None:
    (encoded,) = matcher.encode([shown(97, 131, matcher)])
    mask = encoded.mask
    assert mask.shape[1:] == encoded.maps.coarse.shape[2:]
    assert mask.sum() == 13 * 17
    (matches,) = matcher.match([encoded], [encoded])
    assert len(matches) > 0
    np.testing.assert_array_equal((matches.points0 + 0.5) % 8, 0)
