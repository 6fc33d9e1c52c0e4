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


@pytest.mark.parametrize(("passes", "sides"), [(2, (56, 84)), (1, (84, 126))])
def test_sides_of_the_first_pass_are_multiples_of_14(
    store: WeightStore, passes: int, sides: tuple[int, int]
) -> None:
    (encoded,) = loaded(store, passes=passes, first_pass=0.648).encode([picture(86, 130)])
    assert encoded.features.coarse.at(1).shape[2:] == sides
    assert [each.at(1).shape[2:] for each in [encoded.features.fine] if each] == [(86, 130)] * (passes - 1)


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
