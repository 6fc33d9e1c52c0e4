"""SuperGlue against its golden vectors; what must hold of any weights; the transport by hand."""

import json

import pytest
import torch
from golden import Stage, assert_stages, golden_arrays, needs_golden, ready, recorded, standin_state
from loma_values import assignment_values
from test_parity_superpoint import golden_network as golden_superpoint
from test_parity_superpoint import image_of

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.networks.layers import mutual_matches
from mkpc_kaggle.matchers.networks.superglue import SuperGlue, log_optimal_transport
from mkpc_kaggle.matchers.networks.superpoint import SuperPointKeypoints

CASES = ["full_60x47", "eval20_33x71", "batch2_20x26", "tiny_1x3"]
THRESHOLDS = ["0.0", "0.5"]
VGA = Size(640, 480)


def golden_network(options):
    return ready(SuperGlue(**options), standin_state("superglue"))


def golden_pairs(golden):
    """The keypoints of both images of each pair of a file, with the file's arrays of that pair."""
    arrays = {
        name: value
        for name, value in golden.items()
        if isinstance(value, torch.Tensor) and not name.startswith("image_size")
    }
    count = len(arrays["keypoints0"]) if arrays["keypoints0"].ndim == 3 else 1
    if count == 1 and arrays["keypoints0"].ndim == 2:
        arrays = {name: value[None] for name, value in arrays.items()}
    for pair in range(count):
        of_pair = {name: value[pair] for name, value in arrays.items()}
        images = [
            SuperPointKeypoints(
                of_pair[f"keypoints{index}"],
                of_pair[f"scores{index}"],
                of_pair[f"descriptors{index}"].mT,
                Size(*golden[f"image_size{index}"].tolist()),
            )
            for index in (0, 1)
        ]
        yield *images, of_pair


def assignment_stages(log_plan, threshold, golden, suffix=""):
    for name, value in assignment_values(log_plan, threshold, suffix).items():
        yield Stage(name, value[0], golden[name], 1e-4 if "scores" in name else 0)


def plan_of(network, image0, image1):
    """The score matrix of a pair, and the logarithm of its transport plan with the dustbins."""
    n0 = len(image0.points)
    with recorded(network, ["final_proj"]) as calls:
        network(image0, image1)
    scores = network.score_matrix(calls["final_proj"][0][1], n0)
    return scores, log_optimal_transport(scores, network.bin_score, network.sinkhorn_iterations)[0]


@torch.inference_mode()
def network_stages(case):
    golden = golden_arrays("superglue", case)
    network = golden_network(json.loads(golden["config"]))
    for image0, image1, arrays in golden_pairs(golden):
        scores, log_plan = plan_of(network, image0, image1)
        for name, got in (("score_matrix", scores), ("log_assignment", log_plan)):
            yield Stage(name, got.view_as(arrays[name]), arrays[name], 1e-3)
        found, plan = network(image0, image1), log_plan[:-1, :-1]
        again = mutual_matches(plan, network.match_threshold)
        yield Stage("pairs", torch.stack([found.index0, found.index1]), torch.stack([again.index0, again.index1]))
        yield from assignment_stages(plan, network.match_threshold, arrays)
        for threshold in THRESHOLDS:
            if f"matches0_threshold{threshold}" in arrays:
                yield from assignment_stages(plan, float(threshold), arrays, f"_threshold{threshold}")


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
        (found,) = detector(image_of(golden[f"image{index}"]))
        yield Stage(f"keypoints{index}", found.points, golden[f"keypoints{index}"])
        yield Stage(f"scores{index}", found.scores, golden[f"scores{index}"], 2e-5)
        images.append(found)
    network = golden_network(config["superglue"])
    _, log_plan = plan_of(network, *images)
    yield from assignment_stages(log_plan[:-1, :-1], network.match_threshold, golden)


@needs_golden
@pytest.mark.parametrize("case", CASES)
def test_every_stage_of_the_network_is_the_golden_one(case):
    assert_stages(network_stages(case))


@needs_golden
@pytest.mark.parametrize("stages", [sinkhorn_stages, pipeline_stages])
def test_the_transport_alone_and_the_way_from_two_images_are_the_golden_ones(stages):
    assert_stages(stages())


@pytest.mark.parametrize(("n0", "n1"), [(0, 0), (0, 5), (5, 0)])
def test_no_keypoints_give_no_matches(n0, n1):
    keypoints = [SuperPointKeypoints(torch.rand(n, 2), torch.rand(n), torch.rand(n, 256), VGA) for n in (n0, n1)]
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
@pytest.mark.parametrize("iterations", [1, 20])
@pytest.mark.parametrize(("m", "n"), [(1, 1), (1, 40), (60, 80)])
def test_the_transport_is_that_of_the_log_domain(m, n, iterations, bin_score, spread):
    """Also where scores are so far apart that most of the plan is below float32's range."""
    scores = spread * torch.randn(2, m, n, generator=torch.Generator().manual_seed(m + n))
    got = log_optimal_transport(scores, torch.tensor(float(bin_score)), iterations)
    expected = plain_transport(scores, bin_score, iterations)
    torch.testing.assert_close(got.double(), expected, rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(got.double().exp(), expected.exp(), rtol=0, atol=5e-4)
