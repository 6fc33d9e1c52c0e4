"""RoMa as a matcher, from checkpoints in the public files' format, with fewer channels and stand-in weights."""

from pathlib import Path

import numpy as np
import pytest
import torch
from checkpoints import dinov2_alone, roma_alone
from roma_values import NARROW, use_narrow
from standin import filled, scene

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers import roma
from mkpc_kaggle.matchers.contract import Picture, Placement, Precision, Training, encoding_bytes
from mkpc_kaggle.matchers.networks.dinov2 import DinoV2, DinoV2Config
from mkpc_kaggle.matchers.networks.roma import RoMa, stretch
from mkpc_kaggle.matchers.roma import RomaMatcher, RomaOptions
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.weights import UNVERIFIED, WeightFile, WeightStore

pytestmark = pytest.mark.filterwarnings("ignore:.*is not verified")


@pytest.fixture(autouse=True)
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    use_narrow(monkeypatch)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> WeightStore:
    """Both files, RoMa's own for outdoors alone."""
    state = filled(RoMa(NARROW), "roma").state_dict()
    directory = tmp_path_factory.mktemp("weights")
    lines = []
    for layout, name, slot in (
        (roma_alone, "roma.pth", "roma-outdoor"),
        (dinov2_alone, "dinov2.pth", "dinov2-vitl14"),
    ):
        torch.save(layout(state), directory / name)
        lines.append(WeightFile(name, -1, UNVERIFIED, "none", slot, "made here"))
    return WeightStore([directory], lines)


def loaded(store: WeightStore, precision: Precision = Precision.FLOAT32, **options: object) -> RomaMatcher:
    return roma.load(store, RomaOptions(**options), Placement(precision=precision))  # type: ignore[arg-type]


def picture(height: int, width: int, shift: int = 0, padding: int = 0) -> Picture:
    content = Size(width, height)
    view = View(Box.whole(content), content, Size(width + padding, height + padding))
    return Picture(view.render(scene(height, width + shift, 3)[:, shift:]), view)


def match_one(matcher: RomaMatcher, first: Picture, second: Picture) -> Matches:
    (matches,) = matcher.match(matcher.encode([first]), matcher.encode([second]))
    return matches


SIZES = [((60, 96), (90, 50)), ((33, 47), (48, 64)), ((6, 120), (40, 40)), ((1, 1), (40, 50))]


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("passes", [1, 2])
def test_matches_lie_on_the_pictures_whatever_their_sizes(
    store: WeightStore, passes: int, sizes: tuple[tuple[int, int], tuple[int, int]]
) -> None:
    matcher = loaded(store, passes=passes, matches=300)
    pictures = [picture(*size, shift) for shift, size in enumerate(sizes)]
    matches = match_one(matcher, *pictures)
    assert 0 < len(matches) <= 300
    assert len(matches.to_image(pictures[0].view, pictures[1].view)) == len(matches)
    assert (matches.scores > 0).all()
    assert (matches.scores <= 1).all()
    padded = [picture(*size, shift, padding=9) for shift, size in enumerate(sizes)]
    assert match_one(matcher, *padded).points0.tobytes() == matches.points0.tobytes()


def test_sides_of_the_first_pass_are_multiples_of_14(store: WeightStore) -> None:
    (encoded,) = loaded(store, first_pass=0.648).encode([picture(86, 130)])
    assert encoded.features.coarse.at(1).shape == (1, 9, 56, 84)
    assert encoded.features.coarse.at(16).shape == (1, 64, 4, 6)
    assert encoded.features.coefficients.shape == (1, 24, 64)
    assert encoded.features.fine is not None
    assert [tuple(level.shape[1:]) for level in encoded.features.fine.levels] == [
        (9, 86, 130), (16, 43, 65), (32, 21, 32), (48, 10, 16)
    ]  # fmt: skip
    (encoded,) = loaded(store, passes=1).encode([picture(86, 130)])
    assert encoded.features.coarse.at(1).shape == (1, 9, 84, 126)
    assert encoded.features.fine is None


def test_the_published_sizes_are_a_stretched_unit_of_864() -> None:
    assert RomaMatcher(None, RomaOptions(), "cpu")._first_size(Size(864, 864)) == (560, 560)  # type: ignore[arg-type]
    assert stretch(torch.Size([560, 560])) == 1.25
    assert stretch(torch.Size([864, 864])) == pytest.approx(1.25 * 1.542857, rel=1e-6)


def test_an_encoding_holds_what_matching_needs_and_its_bytes_are_counted(store: WeightStore) -> None:
    for precision, width in ((Precision.FLOAT32, 4), (Precision.BFLOAT16, 2)):
        (encoded,) = loaded(store, precision).encode([picture(64, 96)])
        features = encoded.features
        levels = [*features.coarse.levels, *features.fine.levels]
        assert encoding_bytes(encoded) == sum(
            each.untyped_storage().nbytes() for each in (*levels, features.coefficients)
        )
        assert encoding_bytes(encoded) == width * sum(map(torch.numel, levels)) + 4 * features.coefficients.numel()


def test_one_way_is_from_the_first_to_the_second(store: WeightStore) -> None:
    matches = match_one(loaded(store, symmetric=False, matches=200), picture(40, 56), picture(50, 36))
    assert len(matches) == 200
    np.testing.assert_allclose(matches.points0, np.rint(matches.points0), atol=1e-4)


def test_a_pair_needs_as_many_passes_of_both(store: WeightStore) -> None:
    (one,), (two,) = (loaded(store, passes=passes).encode([picture(40, 56)]) for passes in (1, 2))
    with pytest.raises(ValueError, match="second pass"):
        loaded(store).match([one], [two])


def test_an_image_of_other_sides_is_refused() -> None:
    with pytest.raises(ValueError, match=r"multiples of 14, not \(28, 30\)"):
        DinoV2(DinoV2Config(8, 1, 1, 2))(torch.zeros(1, 3, 28, 30))


def test_the_training_says_which_weights(store: WeightStore) -> None:
    with pytest.raises(KeyError, match="roma-indoor"):
        loaded(store, training=Training.INDOOR)


def test_another_networks_checkpoint_is_refused(store: WeightStore, tmp_path: Path) -> None:
    for name in ("roma.pth", "dinov2.pth"):
        torch.save({"weight": torch.ones(3)}, tmp_path / name)
    with pytest.raises(UserError, match="'roma-outdoor with dinov2-vitl14' do not fit the network"):
        roma.load(WeightStore([tmp_path], store.files), RomaOptions(), Placement())


@pytest.mark.parametrize("precision", [Precision.BFLOAT16, Precision.FLOAT16])
def test_half_precision_moves_most_targets_little(store: WeightStore, precision: Precision) -> None:
    """Where the best anchor changes they move by much: few, as these weights have no sure ones."""
    pictures = picture(56, 70), picture(56, 70, 8)
    warps = []
    for each in (Precision.FLOAT32, precision):
        matcher = loaded(store, each, passes=1, symmetric=False)
        first, second = (encoded.features for encoded in matcher.encode(pictures))
        (dense,) = matcher._network.match(first, second)
        assert dense.warp.dtype == dense.certainty.dtype == torch.float32
        warps.append(dense.warp[..., 2:])
    moved = (warps[0] - warps[1]).norm(dim=-1)
    assert 0 < moved.median() < 0.02
    assert (moved > 0.1).float().mean() < 0.2


UNITS = (Unit(1, "roma", area="48x64"), Unit(2, "roma", area="60x60", stretch=True))


@pytest.mark.parametrize("shapes", [((90, 120), (120, 70)), ((33, 47), (20, 400)), ((60, 80), None)])
def test_both_stages_run_with_it(
    store: WeightStore, shapes: tuple[tuple[int, int], tuple[int, int] | None]
) -> None:
    """Landscape and portrait, tiny and long, and a flat picture."""
    first = scene(*shapes[0], 3)
    second = np.full((60, 80, 3), 128, np.uint8) if shapes[1] is None else scene(*shapes[1], 3)
    match = TwoStageMatcher(Recipe(UNITS), matchers={"roma": loaded(store, matches=200)})(first, second)
    assert [result.failure for result in match.results] == ["", ""]
    assert all(0 < len(result.matches) <= 200 for result in match.results)
    assert np.isfinite(match.estimate.matrix).all()
