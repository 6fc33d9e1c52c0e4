"""The semi-dense networks as matchers, from checkpoints wrapped as the public ones are, with stand-in weights."""

from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from checkpoints import PublicFile, store_of, wrapped
from pictures import picture
from torch import nn

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.adapters import aspanformer, loftr, quadtree
from mkpc_kaggle.matchers.contract import Picture, Placement, Training
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY
from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.matchers.semi_dense import SemiDenseMatcher

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
