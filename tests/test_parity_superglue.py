"""SuperGlue stage by stage against its golden vectors; what must hold of any weights; the transport by hand.

``python tests/test_parity_superglue.py`` prints how far every stage of every case is off.
"""

import json
from dataclasses import replace
from functools import cache

import pytest
import torch
from golden import Stage, assert_stages, golden_arrays, needs_golden, print_table, ready, standin_state
from test_parity_superpoint import golden_network as golden_superpoint
from test_parity_superpoint import image_of
from torch.nn import functional

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.networks.assignment import mutual_matches
from mkpc_kaggle.matchers.networks.superglue import (
    ImageKeypoints,
    SuperGlue,
    SuperGlueConfig,
    log_optimal_transport,
    normalise_points,
)

CASES = ["full_60x47", "eval20_33x71", "batch2_20x26", "tiny_1x3"]
THRESHOLDS = ["0.0", "0.5"]
VGA = Size(640, 480)


@cache
def standin():
    return standin_state("superglue")


def golden_network(options):
    return ready(SuperGlue(SuperGlueConfig(**options)), standin())


def golden_keypoints(golden, index):
    points, scores, descriptors = (golden[f"{name}{index}"] for name in ("keypoints", "scores", "descriptors"))
    if points.ndim == 2:
        points, scores, descriptors = points[None], scores[None], descriptors[None]
    return ImageKeypoints(points, scores, descriptors.mT, Size(*golden[f"image_size{index}"].tolist()))


def assignment_stages(found, golden, suffix=""):
    for name, got, tolerance in (
        (f"matches0{suffix}", found.matches0, 0),
        (f"matches1{suffix}", found.matches1, 0),
        ("matching_scores0", found.scores0, 1e-4),
        ("matching_scores1", found.scores1, 1e-4),
    ):
        yield Stage(name, got.view_as(golden[name]), golden[name], tolerance)


def feature_stages(network, image0, image1):
    """The features of both images at every stage up to the score matrix, with the tolerance of each."""
    n0 = image0.points.shape[1]
    yield "kenc", torch.cat([network.position(image0), network.position(image1)], dim=1), 2e-6
    x = torch.cat([network.encoded(image0), network.encoded(image1)], dim=1)
    for number, layer in enumerate(network.gnn.layers, start=1):
        tolerance = 2e-6 if number <= 2 else 5e-5
        message = layer.message(x, n0)
        yield f"gnn{number}_message", message, tolerance
        x = layer.update(x, message)
        yield f"gnn{number}_desc", x, tolerance
    yield "mdesc", network.final_proj(x), 2e-4


@torch.inference_mode()
def network_stages(case):
    golden = golden_arrays("superglue", case)
    network = golden_network(json.loads(golden["config"]))
    image0, image1 = golden_keypoints(golden, 0), golden_keypoints(golden, 1)
    n0 = image0.points.shape[1]
    for name, features, tolerance in feature_stages(network, image0, image1):
        for index, part in enumerate((features[:, :n0], features[:, n0:])):
            if f"{name}{index}" in golden:
                expected = golden[f"{name}{index}"]
                yield Stage(f"{name}{index}", part.mT.reshape(expected.shape), expected, tolerance)
    scores = network.score_matrix(features, n0)  # of the last stage
    log_plan = log_optimal_transport(scores, network.bin_score, network.config.sinkhorn_iterations)
    for name, got in (("score_matrix", scores), ("log_assignment", log_plan)):
        yield Stage(name, got.view_as(golden[name]), golden[name], 1e-3)
    yield from assignment_stages(network(image0, image1), golden)
    for threshold in THRESHOLDS:
        if f"matches0_threshold{threshold}" in golden:
            yield from assignment_stages(
                mutual_matches(log_plan[:, :-1, :-1], float(threshold)), golden, f"_threshold{threshold}"
            )


def sinkhorn_stages():
    golden = golden_arrays("superglue", "sinkhorn")
    for iterations in (1, 2, 5, 20, 100):
        got = log_optimal_transport(golden["score_matrix"], golden["bin_score"], iterations)
        yield Stage(f"log_assignment_{iterations}", got, golden[f"log_assignment_{iterations}"], 1e-5)


def pipeline_stages():
    """SuperPoint, then SuperGlue."""
    golden = golden_arrays("superglue", "pipeline_pair")
    config = json.loads(golden["config"])
    detector = golden_superpoint(json.dumps(config["superpoint"]))
    images = []
    for index in (0, 1):
        pixels = golden[f"image{index}"]
        (found,) = detector(image_of(pixels))
        yield Stage(f"keypoints{index}", found.points, golden[f"keypoints{index}"])
        yield Stage(f"scores{index}", found.scores, golden[f"scores{index}"], 2e-5)
        size = Size(pixels.shape[1], pixels.shape[0])
        images.append(ImageKeypoints(found.points[None], found.scores[None], found.descriptors[None], size))
    yield from assignment_stages(golden_network(config["superglue"])(*images), golden)


@needs_golden
@pytest.mark.parametrize("case", CASES)
def test_every_stage_of_the_network_is_the_golden_one(case):
    assert_stages(network_stages(case))


@needs_golden
def test_the_transport_alone_is_the_golden_one():
    assert_stages(sinkhorn_stages())


@needs_golden
def test_from_two_images_to_the_golden_matches():
    assert_stages(pipeline_stages())


@needs_golden
def test_half_precision_gives_mostly_the_same_matches():
    golden = golden_arrays("superglue", "eval20_33x71")
    network = golden_network(json.loads(golden["config"])).bfloat16()
    found = network(golden_keypoints(golden, 0), golden_keypoints(golden, 1))
    assert found.scores0.dtype == torch.float32
    assert (found.matches0[0] == golden["matches0"]).float().mean() > 0.8


@cache
def network():
    """Random weights whose attention and scores are far from uniform."""
    torch.manual_seed(0)
    network = SuperGlue(SuperGlueConfig(sinkhorn_iterations=20, match_threshold=0.0))
    with torch.no_grad():
        for layer in network.gnn.layers:
            layer.attn.proj[0].weight.mul_(8)
            layer.attn.proj[1].weight.mul_(8)
        network.final_proj.weight.mul_(8)
    return network


def keypoints(seed, n, batch=1, size=VGA):
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(batch, n, 2, generator=generator) * torch.tensor(size)
    scores = torch.rand(batch, n, generator=generator)
    return ImageKeypoints(
        points, scores, functional.normalize(torch.randn(batch, n, 256, generator=generator), dim=2), size
    )


def taken(image, index):
    """The keypoints ``index`` of an image, in that order, in every pair."""
    return replace(
        image,
        points=image.points[:, index],
        scores=image.scores[:, index],
        descriptors=image.descriptors[:, index],
    )


def one_of(image, pair):
    part = slice(pair, pair + 1)
    return replace(
        image, points=image.points[part], scores=image.scores[part], descriptors=image.descriptors[part]
    )


def assert_same(found, expected):
    assert torch.equal(found.matches0, expected.matches0)
    assert torch.equal(found.matches1, expected.matches1)
    torch.testing.assert_close(found.scores0, expected.scores0, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.scores1, expected.scores1, rtol=0, atol=1e-4)


def alike(n):
    """Two images with ``n`` keypoints in common and some of their own."""
    image0, image1 = keypoints(1, n + 9), keypoints(2, n + 4)
    shared = image0.descriptors[:, :n] + 0.02 * image1.descriptors[:, :n]
    descriptors1 = torch.cat([functional.normalize(shared, dim=2), image1.descriptors[:, n:]], dim=1)
    return image0, replace(image1, descriptors=descriptors1, points=image1.points)


@pytest.mark.parametrize(("n0", "n1"), [(0, 0), (0, 5), (5, 0)])
def test_no_keypoints_give_no_matches(n0, n1):
    found = network()(keypoints(0, n0, batch=2), keypoints(1, n1, batch=2))
    for matches, scores, n in ((found.matches0, found.scores0, n0), (found.matches1, found.scores1, n1)):
        assert torch.equal(matches, torch.full((2, n), -1))
        assert torch.equal(scores, torch.zeros(2, n))


def test_a_batch_equals_its_pairs():
    image0, image1 = keypoints(3, 21, batch=3), keypoints(4, 30, batch=3, size=Size(400, 900))
    found = network()(image0, image1)
    for pair in range(3):
        alone = network()(one_of(image0, pair), one_of(image1, pair))
        assert torch.equal(found.matches0[pair], alone.matches0[0])
        assert torch.equal(found.matches1[pair], alone.matches1[0])
        torch.testing.assert_close(found.scores0[pair], alone.scores0[0], rtol=0, atol=1e-4)


def test_the_order_of_keypoints_does_not_matter():
    image0, image1 = alike(20)
    order0 = torch.randperm(29, generator=torch.Generator().manual_seed(5))
    order1 = torch.randperm(24, generator=torch.Generator().manual_seed(6))
    expected = network()(image0, image1)
    found = network()(taken(image0, order0), taken(image1, order1))
    assert (expected.matches0 >= 0).sum() >= 5
    partner = torch.where(found.matches0 >= 0, order1[found.matches0], -1)
    assert torch.equal(partner, expected.matches0[:, order0])
    torch.testing.assert_close(found.scores0, expected.scores0[:, order0], rtol=0, atol=1e-4)
    torch.testing.assert_close(found.scores1, expected.scores1[:, order1], rtol=0, atol=1e-4)


def test_matches_are_inverse_to_each_other():
    image0, image1 = alike(20)
    found = network()(image0, image1)
    for index0, index1 in enumerate(found.matches0[0].tolist()):
        if index1 >= 0:
            assert found.matches1[0, index1] == index0
            assert found.scores1[0, index1] == found.scores0[0, index0] > 0
    assert (found.matches0 >= 0).sum() == (found.matches1 >= 0).sum()


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


@pytest.mark.parametrize("spread", [1, 30, 300])
@pytest.mark.parametrize("bin_score", [-50, 2, 90])
@pytest.mark.parametrize("iterations", [1, 4, 20, 100])
@pytest.mark.parametrize(("m", "n"), [(1, 1), (1, 40), (37, 5), (60, 80)])
def test_the_transport_is_that_of_the_log_domain(m, n, iterations, bin_score, spread):
    """Also where scores are so far apart that most of the plan is below float32's range."""
    scores = spread * torch.randn(2, m, n, generator=torch.Generator().manual_seed(m + n))
    got = log_optimal_transport(scores, torch.tensor(float(bin_score)), iterations)
    expected = plain_transport(scores, bin_score, iterations)
    torch.testing.assert_close(got.double(), expected, rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(got.double().exp(), expected.exp(), rtol=0, atol=5e-4)


def test_the_plans_rows_and_columns_hold_their_masses():
    m, n = 30, 45
    scores = 3 * torch.randn(2, m, n, generator=torch.Generator().manual_seed(0))
    plan = log_optimal_transport(scores, torch.tensor(1.0), 100).exp()
    rows, columns = torch.ones(2, m + 1), torch.ones(2, n + 1)
    rows[:, m], columns[:, n] = n, m
    torch.testing.assert_close(plan.sum(dim=1), columns, rtol=1e-5, atol=0)  # the last to be scaled
    torch.testing.assert_close(plan.sum(dim=2), rows, rtol=1e-3, atol=0)


def test_only_mutual_pairs_score_and_the_threshold_cuts_matches_alone():
    scores = torch.tensor([[[0.6, 0.3, 0.0], [0.7, 0.1, 0.1], [0.1, 0.2, 0.4]]])
    found = mutual_matches(scores.log(), 0.5)
    assert found.matches0.tolist() == [[-1, 0, -1]]
    assert found.matches1.tolist() == [[1, -1, -1]]
    assert found.scores0.flatten().tolist() == pytest.approx([0, 0.7, 0.4])
    assert found.scores1.flatten().tolist() == pytest.approx([0.7, 0, 0.4])


def test_points_are_normalised_by_one_scale_for_both_axes():
    points = torch.tensor([[[320.0, 240.0], [0, 0], [640, 480]]])
    expected = torch.tensor([[[0, 0], [-320, -240], [320, 240]]]) / (0.7 * 640)
    torch.testing.assert_close(normalise_points(points, Size(640, 480)), expected)


def test_a_transport_without_iterations_is_refused():
    with pytest.raises(ValueError, match="at least one iteration"):
        SuperGlueConfig(sinkhorn_iterations=0)


if __name__ == "__main__":
    tables = [(case, network_stages(case)) for case in CASES]
    print_table("superglue", [*tables, ("sinkhorn", sinkhorn_stages()), ("pipeline_pair", pipeline_stages())])
