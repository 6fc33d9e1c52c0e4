"""SuperPoint and SuperGlue: the matcher from checkpoints in the public format, and its parts by hand."""

import pytest
import torch
from checkpoints import FILES, PublicFile, store_of
from standin import filled

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.adapters import superglue
from mkpc_kaggle.matchers.contract import Placement, Training
from mkpc_kaggle.matchers.networks.superglue import SuperGlue, log_optimal_transport
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint, SuperPointKeypoints
from mkpc_kaggle.weights import WeightStore

OPTIONS = superglue.SuperGlueOptions(max_keypoints=300, keypoint_threshold=0.0, match_threshold=0.0)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> WeightStore:
    return store_of(tmp_path_factory.mktemp("weights"), [file for file in FILES if file.matcher == "superglue"])


def test_indoor_weights_are_another_slot_and_another_networks_checkpoint_is_refused(store, tmp_path):
    indoor = superglue.SuperGlueOptions(training=Training.INDOOR)
    assert superglue.SPEC.slots_for(indoor) == ("superpoint", "superglue-indoor")
    with pytest.raises(UserError, match="superglue-indoor"):
        superglue.load(store, indoor, Placement())
    wrong = store_of(tmp_path, [PublicFile("x.pth", "superglue", "superpoint", "superglue", SuperGlue)])
    with pytest.raises(UserError, match="'superpoint' do not fit the network"):
        superglue.load(wrong, OPTIONS, Placement())


@pytest.mark.parametrize(("n0", "n1"), [(0, 0), (0, 5), (5, 0)])
def test_no_keypoints_give_no_matches(n0, n1):
    keypoints = [
        SuperPointKeypoints(torch.rand(n, 2), torch.rand(n), torch.rand(n, 256), Size(640, 480)) for n in (n0, n1)
    ]
    found = SuperGlue(match_threshold=0.0)(*keypoints)
    assert [each.shape for each in (found.index0, found.index1, found.scores)] == [(0,)] * 3


def plain_transport(scores, bin_score, iterations):
    """The definition in the log domain, in float64."""
    batch, m, n = scores.shape
    couplings = torch.full((batch, m + 1, n + 1), float(bin_score), dtype=torch.float64)
    couplings[:, :m, :n] = scores
    norm = -torch.tensor(float(m + n), dtype=torch.float64).log()
    log_rows, log_columns = norm.repeat(m + 1), norm.repeat(n + 1)
    log_rows[m] += torch.tensor(float(n)).log()
    log_columns[n] += torch.tensor(float(m)).log()
    u, v = torch.zeros(batch, m + 1).double(), torch.zeros(batch, n + 1).double()
    for _ in range(iterations):
        u = log_rows - (couplings + v[:, None]).logsumexp(2)
        v = log_columns - (couplings + u[:, :, None]).logsumexp(1)
    return couplings + u[:, :, None] + v[:, None] - norm


@pytest.mark.parametrize("spread", [1, 300])
@pytest.mark.parametrize("bin_score", [-50, 90])
@pytest.mark.parametrize(("m", "n", "iterations"), [(1, 1, 20), (1, 40, 1), (60, 80, 20)])
def test_the_transport_is_that_of_the_log_domain(m, n, iterations, bin_score, spread):
    """Also where scores are so far apart that most of the plan is below float32's range."""
    scores = spread * torch.randn(2, m, n, generator=torch.Generator().manual_seed(m + n))
    got = log_optimal_transport(scores, torch.tensor(float(bin_score)), iterations)
    expected = plain_transport(scores, bin_score, iterations)
    torch.testing.assert_close(got.double(), expected, rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(got.double().exp(), expected.exp(), rtol=0, atol=5e-4)


def test_the_threshold_is_strict_and_the_limit_keeps_the_strongest_in_order():
    scores = torch.zeros(16, 24)
    scores[4, 4], scores[4, 19], scores[11, 4], scores[11, 19] = 0.25, 0.5, 0.75, 0.125
    scores[12, 9], scores[9, 20] = 1, 1

    def selected(**options):
        points, kept = SuperPoint(keypoint_threshold=0.125, **options).select_keypoints(scores)
        assert torch.equal(scores[points[:, 1].long(), points[:, 0].long()], kept)
        return points.tolist()

    in_rows = [[4, 4], [19, 4], [4, 11]]
    assert selected() == selected(max_keypoints=3) == selected(max_keypoints=9) == in_rows
    assert selected(max_keypoints=2) == [[4, 11], [19, 4]]
    assert [20, 9] in selected(border=3)


def test_a_batch_equals_its_images():
    network = filled(SuperPoint(max_keypoints=20), "superpoint")
    batch = torch.rand(3, 1, 45, 62)
    for found, image in zip(network(batch), batch, strict=True):
        (alone,) = network(image[None])
        torch.testing.assert_close(found.scores, alone.scores, rtol=1e-4, atol=1e-7)
        assert torch.equal(found.points, alone.points)
        assert len(alone.points) == 20
        assert (alone.scores.diff() <= 0).all()
        assert ((alone.points >= 4) & (alone.points < torch.tensor([56 - 4, 40 - 4]))).all()
    assert network(batch[:0]) == []
