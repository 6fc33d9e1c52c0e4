"""LoMa against golden files, network by network, norms folded."""

import re
from functools import cache, partial

import numpy as np
import torch
from dense_stages import resized_by_pil
from golden import Stage, Within, compared, golden_arrays, in_order, recorded, standin_state
from sparse_stages import assignment_values

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.networks.dad import select_keypoints
from mkpc_kaggle.matchers.networks.loma import (
    UNUSED,
    Loma,
    Variant,
    detector_size,
    parameter_name,
)
from mkpc_kaggle.matchers.networks.loma_matcher import (
    LAYERS,
    LomaKeypoints,
    LomaMatcher,
    log_scores,
)
from mkpc_kaggle.matchers.networks.placement import prepared
from mkpc_kaggle.weights import load_into

# Above rounding in float32, and far below what another operation, order or padding changes.
TOLERANCES = {
    "score_map": 1e-4,
    "keypoints": 1e-6,
    "dense_descriptors": 2e-4,
    "descriptors": 2e-4,
    "similarity": 1e-3,
    "scores": 1e-4,
    "matching_scores": 1e-4,
    "dense_probs": Within(relative=1e-4),
}


@cache
def whole(variant):
    network = Loma(variant)
    tensors = {
        parameter_name(n): t for n, t in standin_state("loma", variant.upper()).items()
    }
    load_into(network, tensors, what="golden", unused=UNUSED)
    return prepared(network, Placement())


@cache
def matcher(variant):
    shapes = {"B128": (128, 256), "B": (256, 256), "L": (256, 512), "G": (256, 1024)}
    network = LomaMatcher(*shapes[variant])
    fitting = {}
    # Without detector and descriptor ("_d..."), which take most of the memory.
    for name, tensor in standin_state("loma", variant, not_prefix="_d").items():
        own = parameter_name(name)
        if not re.match(UNUSED, own):
            fitting[own.removeprefix("matcher.")] = tensor
    load_into(network, fitting, what="golden")
    return prepared(network, Placement())


def image_of(pixels: np.ndarray) -> torch.Tensor:
    """(..., H, W, 3) uint8 -> (B, 3, H, W) in 0..1."""
    image = torch.from_numpy((pixels.numpy() / 255).astype(np.float32))
    return image.reshape(-1, *pixels.shape[-3:]).permute(0, 3, 1, 2)


def matcher_values(matcher, image0, image1, threshold):
    """Of a single pair, as a batch of one."""
    with recorded(matcher, f"transformers.{LAYERS - 1}") as calls:
        matcher(image0, image1, threshold)
    similarity = matcher.similarity(calls[0][1], len(image0.points))
    scores = log_scores(similarity)
    values = {"similarity": similarity, "scores": scores.exp()}
    return values | assignment_values(scores[0], threshold)


def detector_stages(case):
    golden = golden_arrays("loma", f"detector_{case}")
    detector = whole(Variant.B128).detector
    images = image_of(golden["image"])
    logits = detector.logits(images)
    found = detector(images, golden["keypoints"].shape[-2])
    values = {
        "score_map": logits,
        "dense_probs": logits.flatten(1).softmax(dim=1).view_as(logits),
        "keypoints": torch.stack(found),
    }
    yield from compared(values, golden, TOLERANCES)


def sampling_stages():
    golden = golden_arrays("loma", "sampling_cases")
    for name in ("ties", "few", "border", "random"):
        found = select_keypoints(golden[f"{name}_map"], int(golden[f"{name}_asked"]))
        expected = golden[f"{name}_keypoints"]
        if name == "ties":
            # Equal scores: which comes first is the processor's affair.
            found = in_order(found)
            expected = in_order(expected)
        yield Stage(f"{name} points", found, expected, 1e-6)


def descriptor_stages(variant, case):
    """Yield descriptors at every third pixel of an image, and at its keypoints."""
    golden = golden_arrays("loma", f"descriptor_{case}")
    descriptor = whole(variant).descriptor
    image = image_of(golden["image"])
    rows, columns = ((2 * torch.arange(side) + 1) / side - 1 for side in image.shape[2:])
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=2)[::3, ::3]
    dense = descriptor(image, pixels.reshape(1, -1, 2)).mT.unflatten(2, pixels.shape[:2])
    values = {
        "dense_descriptors": dense[:, ::32],  # the channels that the file keeps
        "descriptors": descriptor(image, golden["keypoints"][None]),
    }
    yield from compared(values, golden, TOLERANCES)


def matcher_stages(case):
    golden = golden_arrays("loma", f"matcher_{case}")
    batched = golden["keypoints0"].ndim == 3
    first, *others = (round(threshold, 3) for threshold in golden["thresholds"].tolist())
    variant = case.split("_")[0].upper()
    for pair in range(len(golden["keypoints0"]) if batched else 1):
        arrays = dict(golden)
        if batched:
            arrays = {
                name: value[pair] for name, value in golden.items() if name != "thresholds"
            }
        image0 = LomaKeypoints(arrays["keypoints0"], arrays["descriptors0"])
        image1 = LomaKeypoints(arrays["keypoints1"], arrays["descriptors1"])
        values = matcher_values(matcher(variant), image0, image1, first)
        log_plan = values["scores"][0].log()
        for threshold in others:
            values |= assignment_values(log_plan, threshold, f"_threshold{threshold}")
        assert {name for name in golden if name.startswith("matches")} <= values.keys()
        yield from compared(values, arrays, TOLERANCES)


def pipeline_stages(case, variant):
    golden = golden_arrays("loma", case)
    network = whole(variant)
    images = golden if "image0" in golden else golden_arrays("loma", "pipeline_b128")
    side = int(golden["descriptor_side"])
    number = int(golden["num_keypoints"])
    found = []
    for index in (0, 1):
        pixels = images[f"image{index}"]
        size = detector_size(
            Size(pixels.shape[1], pixels.shape[0]), int(golden["detector_size"])
        )
        assert (1, 3, size.height, size.width) == tuple(
            golden[f"detector_input_shape{index}"].tolist()
        )
        seen = [
            image_of(resized_by_pil(pixels, shape)) for shape in (size[::-1], (side, side))
        ]
        keypoints = network.encode(*seen, number)
        found.append(keypoints)
        values = {"keypoints": keypoints.points, "descriptors": keypoints.descriptors}
        yield from compared(values, golden, TOLERANCES, suffix=index)
    threshold = float(golden["threshold"])
    values = matcher_values(network.matcher, *found, threshold)
    assigned = {name: value for name, value in values.items() if name.startswith("match")}
    yield from compared(assigned, golden, {"matching_scores": 4e-4})
    matches = network.matcher(*found, threshold)
    points = []
    for index, of in enumerate((matches.index0, matches.index1)):
        height, width = images[f"image{index}"].shape[:2]
        # The reference's points count from the corner of the image.
        points.append((found[index].points[of] + 1) / 2 * torch.tensor([width, height]))
    expected = torch.cat([golden["points0"], golden["points1"]], dim=1)
    yield Stage("points", torch.cat(points, dim=1), expected, 1e-3)


DETECTIONS = ("160x208", "157x203", "batch2_72x96")
CASES = {f"loma detector_{case}": partial(detector_stages, case) for case in DETECTIONS}
CASES["loma sampling"] = sampling_stages
CASES["loma descriptor_b128"] = partial(descriptor_stages, Variant.B128, "b128_157x203")
CASES |= {
    f"loma matcher_{case}": partial(matcher_stages, case)
    for case in ("b_60x47", "b128_33x71", "l_24x18", "b_batch2_20x26", "b_1x3", "b_1x1")
}
CASES["loma pipeline_b128"] = partial(pipeline_stages, "pipeline_b128", Variant.B128)
