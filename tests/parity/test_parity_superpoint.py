"""SuperPoint stage by stage against its golden vectors; what must hold of any weights; by hand on small maps."""

import json

import pytest
import torch
from golden import Stage, assert_stages, golden_arrays, needs_golden, ready, standin_state
from standin import filled
from torch.nn import functional

from mkpc_kaggle.matchers.networks.superpoint import SuperPoint, sample_descriptors, score_map, suppress_non_maxima

CASES = ["default_160x216", "outdoor_160x216", "odd_171x229", "noborder_64x72"]


def golden_network(config):
    options = json.loads(config)
    assert options.pop("descriptor_dim") == 256
    options["border"] = options.pop("remove_borders")
    return ready(SuperPoint(**options), standin_state("superpoint"))


def image_of(pixels):
    return pixels[None, None].float() / 255


@torch.inference_mode()
def network_stages(case):
    golden = golden_arrays("superpoint", case)
    network = golden_network(golden["config"])
    image = image_of(golden["image"])
    features = network.features(image)
    logits, field = network.logits(features), network.descriptor_field(features)
    scores = score_map(logits)
    suppressed = suppress_non_maxima(scores, network.nms_radius)
    (found,) = network(image)
    got = {
        "conv4b_relu": (features[0], 1e-4),
        "logits": (logits[0], 1e-4),
        "descriptor_raw": (field[0], 1e-4),
        "dense_descriptors": (functional.normalize(field[0], dim=0), 1e-5),
        "score_map": (scores[0], 2e-5),
        "score_map_nms": (suppressed[0], 2e-5),
        "keypoints": (found.points, 0),
        "scores": (found.scores, 2e-5),
        "descriptors": (found.descriptors.T, 1e-5),
    }
    yield from (Stage(name, *got[name][:1], golden[name], got[name][1]) for name in got if name in golden)
    if "score_map_nms" in golden:
        survivors, expected = (values > 0 for values in (suppressed[0], golden["score_map_nms"]))
        yield Stage("surviving pixels", survivors.long(), expected.long())


def nms_stages():
    golden = golden_arrays("superpoint", "nms_cases")
    for name in ("ties", "ramp", "random"):
        for radius in range(5):
            got = suppress_non_maxima(golden[name][None], radius)[0]
            yield Stage(f"{name}, radius {radius}", got, golden[f"{name}_nms{radius}"])


def sampling_stages():
    golden = golden_arrays("superpoint", "descriptor_sampling")
    got = sample_descriptors(golden["field"], golden["keypoints"])
    yield Stage("descriptors", got.T, golden["descriptors"], 1e-5)


@needs_golden
@pytest.mark.parametrize("case", CASES)
def test_every_stage_of_the_network_is_the_golden_one(case):
    assert_stages(network_stages(case))


@needs_golden
@pytest.mark.parametrize("stages", [nms_stages, sampling_stages])
def test_steps_without_weights_are_the_golden_ones(stages):
    assert_stages(stages())


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
