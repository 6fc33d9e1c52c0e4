"""RoMa as a matcher, from checkpoints in the public files' format, with fewer channels and stand-in weights."""

import pytest
import torch
from checkpoints import FILES, store_of
from pictures import as_picture, picture
from standin import scene, use_narrow

from mkpc_kaggle.matchers.adapters import roma
from mkpc_kaggle.matchers.adapters.roma import RomaMatcher, RomaOptions
from mkpc_kaggle.matchers.contract import Placement, Precision
from mkpc_kaggle.weights import WeightStore


@pytest.fixture(autouse=True)
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    use_narrow(monkeypatch)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> WeightStore:
    return store_of(tmp_path_factory.mktemp("weights"), [file for file in FILES if file.matcher == "roma"])


def loaded(store: WeightStore, precision: Precision = Precision.FLOAT32, **options: object) -> RomaMatcher:
    return roma.load(store, RomaOptions(**options), Placement(precision=precision))


def test_sides_of_the_first_pass_are_multiples_of_14(store: WeightStore) -> None:
    (encoded,) = loaded(store, first_pass=0.648).encode([picture(86, 130)])
    assert encoded.features.coarse.at(1).shape == (1, 9, 56, 84)
    assert encoded.features.coarse.at(16).shape == (1, 64, 4, 6)
    assert [each.shape for each in encoded.features.coefficients] == [(1, 24, 64)]
    assert encoded.features.fine is not None
    assert [tuple(level.shape[1:]) for level in encoded.features.fine.levels] == [
        (9, 86, 130), (16, 43, 65), (32, 21, 32), (48, 10, 16)
    ]  # fmt: skip
    (encoded,) = loaded(store, passes=1).encode([picture(86, 130)])
    assert encoded.features.coarse.at(1).shape == (1, 9, 84, 126)
    assert encoded.features.fine is None


@pytest.mark.parametrize("precision", [Precision.BFLOAT16, Precision.FLOAT16])
def test_half_precision_moves_most_targets_little(store: WeightStore, precision: Precision) -> None:
    """Where the best anchor changes they move by much: few, as these weights have no sure ones."""
    whole = scene(56, 78, 3)
    pictures = as_picture(whole[:, :70]), as_picture(whole[:, 8:])
    warps = []
    for each in (Precision.FLOAT32, precision):
        matcher = loaded(store, each, passes=1)
        first, second = (encoded.features for encoded in matcher.encode(pictures))
        dense, _ = matcher._network.match(first, second)
        assert dense.warp.dtype == dense.certainty.dtype == torch.float32
        warps.append(dense.warp[..., 2:])
    moved = (warps[0] - warps[1]).norm(dim=-1)
    assert 0 < moved.median() < 0.02
    assert (moved > 0.1).float().mean() < 0.2
