"""What half precision changes: less than a grey level of noise in the pictures does, and little in all.

The weights are stand-ins, so that the bounds are of the arithmetic, not of the matching.
"""

import numpy as np
import pytest
import torch
from pictures import agreement
from standin import filled, scene

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.contract import Placement, Precision
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.pixels import network_input
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.pipeline.devices import fastest_precision, resolve_placement

SIZE = Size(224, 160)
MAKERS = {"loftr": Loftr, "quadtree": Quadtree, "aspanformer": AspanFormer, "dkm": DKM}
half_precisions = pytest.mark.parametrize("precision", [Precision.BFLOAT16, Precision.FLOAT16])


def network(name, precision=Precision.FLOAT32):
    return prepared(filled(MAKERS[name](), name), Placement(precision=precision))


def pictures(size, channels):
    """Two views (1, C, H, W) uint8, the second 8 pixels further right."""
    picture = torch.from_numpy(scene(size.height, size.width + 8, channels)).permute(2, 0, 1)[None]
    return picture[..., 8:], picture[..., :-8]


def noisy(picture):
    """Each value a grey level darker or lighter, or as it was."""
    noise = torch.from_numpy(np.random.default_rng(0).integers(-1, 2, picture.shape))
    return (picture + noise).clamp(0, 255).to(torch.uint8)


@torch.inference_mode()
def semi_dense_matches(name, views, precision=Precision.FLOAT32):
    """(M, 4): the points of both views."""
    matcher = network(name, precision)
    matches = matcher.match(*(matcher.encode(view.float() / 255) for view in views))
    assert matches.points1.dtype == matches.coarse.confidence.dtype == torch.float32
    return torch.cat([matches.points0, matches.points1], dim=1)


@half_precisions
@pytest.mark.parametrize("name", ["loftr", "quadtree", "aspanformer"])
def test_semi_dense_matches_move_less_than_by_noise(name, precision):
    views = pictures(SIZE, 1)
    exact = semi_dense_matches(name, views)
    half = semi_dense_matches(name, views, precision)
    disturbed = semi_dense_matches(name, map(noisy, views))
    assert len(exact) > 200
    assert agreement(exact, half, within=0.25) > agreement(exact, disturbed, within=0.25)
    assert agreement(exact, half, within=1.0) > 0.9
    assert not torch.equal(exact, half)


@half_precisions
@torch.inference_mode()
def test_dkm_warps_move_less_than_by_noise(precision):
    views = pictures(Size(128, 96), 3)

    def targets(views, precision=Precision.FLOAT32):
        matcher = network("dkm", precision)
        dense = matcher.match(*(matcher.encode(network_input(view, (96, 128))) for view in views))[0]
        assert dense.warp.dtype == dense.certainty.dtype == torch.float32
        return dense.warp[..., 2:]

    exact = targets(views)
    moved = {
        name: (exact - other).norm(dim=-1).median()
        for name, other in (("half", targets(views, precision)), ("noise", targets([*map(noisy, views)])))
    }
    assert 0 < moved["half"] < 0.5 * moved["noise"]


def test_auto_takes_half_precision_where_the_processor_has_it(monkeypatch):
    for flags, expected in (
        ({"avx512_bf16": True}, Precision.BFLOAT16),
        ({"amx_bf16": True, "avx512_bf16": False}, Precision.BFLOAT16),
        ({"avx2": True}, Precision.FLOAT32),
    ):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda flags=flags: flags, raising=False)
        assert resolve_placement("cpu", "auto") == Placement("cpu", expected)
    monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert fastest_precision("cpu") is Precision.FLOAT32
