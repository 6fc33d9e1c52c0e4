"""LoFTR, QuadTree and ASpanFormer: properties of the networks, and the matchers from public checkpoints."""

from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from checkpoints import PublicFile, store_of, wrapped
from light_matchers import MATCHERS
from pictures import picture
from torch import nn

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.adapters import aspanformer, loftr, quadtree
from mkpc_kaggle.matchers.contract import Placement, Training
from mkpc_kaggle.matchers.networks.adaptive_span import CELLS_AT_ONCE, span_attention
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.coarse_matching import coarse_matches
from mkpc_kaggle.matchers.networks.grids import as_map, to_2x2_blocks
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY
from mkpc_kaggle.matchers.networks.quadtree import Quadtree


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


@pytest.mark.parametrize("name", ["loftr", "quadtree", "aspanformer"])
def test_points_of_image_0_are_centres_of_cells_within_the_border_of_the_content(name: str) -> None:
    matcher = MATCHERS[name](Placement())
    padded = picture(97, 131, channels=1, multiple=matcher.spec.multiple, padding=(20, 40))
    whole = picture(97, 131, channels=1, multiple=matcher.spec.multiple)
    first, second = matcher.encode([padded]) + matcher.encode([whole])
    assert first.mask.sum() == 13 * 17
    (matches,) = matcher.match([first], [second])
    assert len(matches) > 0
    cells = (matches.points0 + 0.5) / 8
    np.testing.assert_array_equal(cells % 1, 0)
    border = matcher._network.border
    assert (cells >= border).all() and (cells < np.array([17, 13]) - border).all()
