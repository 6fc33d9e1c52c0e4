"""SuperPoint and SuperGlue against golden files, stage by stage."""

import json
from functools import partial
from unittest.mock import patch

import torch
from golden import Stage, compared, golden_arrays, ready, recorded, standin_state
from torch.nn import functional

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.networks import superpoint
from mkpc_kaggle.matchers.networks.layers import mutual_matches
from mkpc_kaggle.matchers.networks.superglue import SuperGlue, log_optimal_transport
from mkpc_kaggle.matchers.networks.superpoint import (
    SuperPoint,
    SuperPointKeypoints,
    score_map,
    suppress_non_maxima,
)

# Rounding in float32; descriptors are normalised, so theirs is smaller.
SUPERPOINT = {
    "conv4b_relu": 1e-4,
    "logits": 1e-4,
    "descriptor_raw": 1e-4,
    "score": 2e-5,
    "dense_descriptors": 1e-5,
    "descriptors": 1e-5,
}
SUPERGLUE = {"score_matrix": 1e-3, "log_assignment": 1e-3, "matching_scores": 1e-4}


def superpoint_stages(case):
    golden = golden_arrays("superpoint", case)
    options = json.loads(golden["config"])
    image = golden["image"][None, None].float() / 255
    border = options.pop("remove_borders")
    del options["descriptor_dim"]
    network = ready(SuperPoint(**options), standin_state("superpoint"))
    features = network.features(image)
    logits = network.logits(features)
    field = network.descriptor_field(features)
    scores = score_map(logits)
    suppressed = suppress_non_maxima(scores, network.nms_radius)
    with patch.object(superpoint, "BORDER", border):
        (found,) = network(image)
    got = {
        "conv4b_relu": features[0],
        "logits": logits[0],
        "descriptor_raw": field[0],
        "score_map": scores[0],
        "dense_descriptors": functional.normalize(field[0], dim=0),
        "score_map_nms": suppressed[0],
        "keypoints": found.points,
        "scores": found.scores,
        "descriptors": found.descriptors.T,
    }
    yield from compared(got, golden, SUPERPOINT)
    if "score_map_nms" in golden:
        # Exactly the same pixels, while their scores may differ by rounding.
        survivors = (suppressed[0] > 0).long()
        yield Stage("surviving pixels", survivors, (golden["score_map_nms"] > 0).long())


def suppression_stages():
    # Scores of a network have hardly ever the ties and ramps on which suppressions differ.
    golden = golden_arrays("superpoint", "nms_cases")
    for name in ("ties", "ramp", "random"):
        for radius in range(5):
            got = suppress_non_maxima(golden[name][None], radius)[0]
            yield Stage(f"{name}, radius {radius}", got, golden[f"{name}_nms{radius}"])


def golden_pairs(golden):
    """Yield the keypoints of both images of each pair of a file, with the file's arrays of that
    pair.
    """
    arrays = {}
    for name, value in golden.items():
        if isinstance(value, torch.Tensor) and not name.startswith("image_size"):
            arrays[name] = value
    if arrays["keypoints0"].ndim == 2:
        arrays = {name: value[None] for name, value in arrays.items()}
    for pair in range(len(arrays["keypoints0"])):
        of_pair = {name: value[pair] for name, value in arrays.items()}
        images = []
        for index in (0, 1):
            points = of_pair[f"keypoints{index}"]
            scores = of_pair[f"scores{index}"]
            descriptors = of_pair[f"descriptors{index}"].mT
            size = Size(*golden[f"image_size{index}"].tolist())
            images.append(SuperPointKeypoints(points, scores, descriptors, size))
        yield *images, of_pair


def assignment_values(log_scores, threshold, suffix=""):
    """Return, by keypoint of either image, its match and the score of any mutual pair; as a batch
    of one.
    """
    found = mutual_matches(log_scores, threshold)
    # The references report the score of a mutual pair also below the threshold.
    every = mutual_matches(log_scores, 0)
    values = {}
    for side, count in enumerate(log_scores.shape):
        matches = torch.full((1, count), -1)
        scores = torch.zeros(1, count)
        matches[0, (found.index0, found.index1)[side]] = (found.index1, found.index0)[side]
        scores[0, (every.index0, every.index1)[side]] = every.scores
        values |= {f"matches{side}{suffix}": matches, f"matching_scores{side}": scores}
    return values


def plan_of(network, image0, image1):
    """Return the score matrix of a pair, and the logarithm of its transport plan with the dustbins."""
    n0 = len(image0.points)
    with recorded(network, "final_proj") as calls:
        network(image0, image1)
    scores = network.score_matrix(calls[0][1], n0)
    plans = log_optimal_transport(scores, network.bin_score, network.sinkhorn_iterations)
    return scores, plans[0]


def superglue_stages(case):
    golden = golden_arrays("superglue", case)
    network = ready(SuperGlue(**json.loads(golden["config"])), standin_state("superglue"))
    for image0, image1, arrays in golden_pairs(golden):
        scores, log_plan = plan_of(network, image0, image1)
        found = network(image0, image1)
        plan = log_plan[:-1, :-1]  # without the dustbins
        again = mutual_matches(plan, network.match_threshold)
        indices = torch.stack([found.index0, found.index1])
        yield Stage("pairs", indices, torch.stack([again.index0, again.index1]))
        values = {"score_matrix": scores, "log_assignment": log_plan}
        for threshold in ("0.0", "0.5"):
            values |= assignment_values(plan, float(threshold), f"_threshold{threshold}")
        values |= assignment_values(plan, network.match_threshold)
        yield from compared(values, arrays, SUPERGLUE)


def sinkhorn_stages():
    golden = golden_arrays("superglue", "sinkhorn")
    # One iteration shows the order of rows and columns, and a hundred the limit.
    for iterations in (1, 2, 5, 20, 100):
        name = f"log_assignment_{iterations}"
        got = log_optimal_transport(golden["score_matrix"], golden["bin_score"], iterations)
        yield Stage(name, got, golden[name], 1e-5)


CASES = {
    f"superpoint {case}": partial(superpoint_stages, case)
    for case in ("default_160x216", "outdoor_160x216", "odd_171x229", "noborder_64x72")
}
CASES |= {
    f"superglue {case}": partial(superglue_stages, case)
    for case in ("full_60x47", "eval20_33x71", "batch2_20x26", "tiny_1x3")
}
CASES |= {"superpoint nms_cases": suppression_stages, "superglue sinkhorn": sinkhorn_stages}
