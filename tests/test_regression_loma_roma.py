"""LoMa, RoMa and ALIKED stage by stage against vectors of our own, see ``vectors``; mistakes must show in them."""

from dataclasses import replace
from functools import cache, partial

import pytest
import roma_values
import torch
from golden import assert_stages
from loma_values import descriptor_values, detector_values, matcher_values
from standin import filled, scene, uniform
from torch.nn import functional
from vectors import Found, main, shifted_inputs, stages_of

from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.networks import (
    aliked,
    anchor_decoder,
    dad,
    dedode_decoder,
    dense_warp,
    dinov2,
    loma_matcher,
    roma,
    vgg,
    warp_refiner,
)
from mkpc_kaggle.matchers.networks.aliked import Aliked
from mkpc_kaggle.matchers.networks.dedode import dedode_g
from mkpc_kaggle.matchers.networks.dinov2 import DinoV2Config
from mkpc_kaggle.matchers.networks.grids import as_grid
from mkpc_kaggle.matchers.networks.loma import Loma, Variant
from mkpc_kaggle.matchers.networks.loma_matcher import LomaKeypoints
from mkpc_kaggle.matchers.networks.placement import placed
from mkpc_kaggle.matchers.networks.roma import RoMa

# LoMa


@cache
def loma():
    return placed(filled(Loma(Variant.B128), "loma"), Placement())


def rgb(picture):
    return torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255


def detector_stages(size):
    values = detector_values(loma().detector, rgb(scene(*size, channels=3)), 100)
    points, scores = values.pop("keypoints")[0], values.pop("keypoint_probs")[0]
    yield from values.items()
    pixels = ((points + 1) * torch.tensor([size[1], size[0]]) / 2).floor()
    offsets = (points + 1) * torch.tensor([size[1], size[0]]) / 2 - pixels
    yield "keypoints", Found(pixels, torch.cat([offsets, scores[:, None]], dim=1))


def descriptor_stages(size, vit=None):
    descriptor = loma().descriptor
    if vit is not None:
        descriptor = placed(filled(dedode_g(32, vit), "loma"), Placement())
    points = torch.from_numpy(1.05 * uniform("points", (1, 60, 2))).float()
    yield from descriptor_values(descriptor, rgb(scene(*size, channels=3)), points).items()


def loma_matcher_stages(counts, batch=1):
    numbers = [torch.from_numpy(uniform(f"points {i}", (batch, n, 2))).float() for i, n in enumerate(counts)]
    described = torch.from_numpy(2 * uniform("descriptors", (batch, sum(counts), 128))).float()
    first, second = described.split(counts, dim=1)
    common = min(counts) // 2
    second[:, :common] = first[:, :common] + 0.3 * second[:, :common]
    values = matcher_values(
        loma().matcher, *map(LomaKeypoints, numbers, (first, second.contiguous())), threshold=0.0
    )
    matches, scores = values.pop("matches0"), values.pop("matching_scores0")
    for name in ("matches1", "matching_scores1"):
        del values[name]
    yield from values.items()
    batches, index0 = torch.nonzero(matches >= 0, as_tuple=True)
    rows = torch.stack([batches, index0, matches[batches, index0]], dim=1)
    yield "matches", Found(rows, scores[batches, index0, None])


# RoMa


@cache
def narrow_roma():
    return filled(RoMa(roma_values.NARROW), "roma")


def roma_stages(size, fine=None, symmetric=True):
    network = narrow_roma()
    network.config = replace(network.config, symmetric=symmetric)
    for name, value in roma_values.computed(network, *shifted_inputs(size, fine)).items():
        if name == "cls_mode":
            rows = torch.nonzero(value >= 0)
            yield name, Found(torch.cat([rows, value.reshape(-1, 1)], dim=1), torch.ones(len(rows), 1))
        else:
            yield name, value


# ALIKED


@cache
def aliked_network():
    return placed(filled(Aliked(max_keypoints=80), "aliked"), Placement())


def aliked_stages(size, batch=1):
    network = aliked_network()
    pictures = [scene(*size, channels=3, name=f"picture {number}") for number in range(batch)]
    images = torch.cat([rgb(picture) for picture in pictures])
    maps = network.maps(images)
    yield from ((f"map {number}", each) for number, each in enumerate(maps))
    yield "scores", network.score_map(maps)
    for number, found in enumerate(network(images)):
        values = torch.cat([found.points - found.points.floor(), found.descriptors[:, ::8]], dim=1)
        yield f"keypoints {number}", Found(found.points.floor(), values)


CASES = {
    ("loma", "detector"): partial(detector_stages, (61, 83)),
    ("loma", "descriptor"): partial(descriptor_stages, (61, 83)),
    ("loma", "descriptor with a vision transformer"): partial(descriptor_stages, (56, 70), DinoV2Config(blocks=1)),
    ("loma", "matcher"): partial(loma_matcher_stages, (60, 47)),
    ("loma", "matcher, batch"): partial(loma_matcher_stages, (9, 31), batch=2),
    ("roma", "one pass"): partial(roma_stages, (70, 84)),
    ("roma", "two passes, one way"): partial(roma_stages, (56, 70), (75, 101), symmetric=False),
    ("aliked", "batch"): partial(aliked_stages, (96, 128), batch=2),
}


@pytest.mark.parametrize(("network", "case"), CASES)
def test_every_stage_is_that_of_the_vectors(network, case):
    assert_stages(stages_of(CASES, network, case))


# Mistakes


def best_anchor(logits):
    grid = as_grid(warp_refiner.identity_map(logits.new_empty(64, 64))).reshape(-1, 2)
    return grid[logits.argmax(dim=-1)]


def no_offsets(self, patches, reach):
    return patches.new_zeros(len(patches), 16, 2)


def nearest(x, size):
    return functional.interpolate(x, tuple(size))


MISTAKES = [  # in a network and case: the module or class, what is changed there, and how
    ("roma", "one pass", dinov2, "OFFSET", 0.0),
    ("roma", "one pass", dinov2, "EPSILON", 1e-2),
    ("roma", "one pass", roma, "DISPLACEMENT", 1.0),
    ("roma", "one pass", roma, "TRAINED_SIDE", 600),
    ("roma", "one pass", roma, "refined", lambda *values: warp_refiner.refined(*values[:2], 14, values[3])),
    ("roma", "one pass", anchor_decoder, "anchor_mean", best_anchor),
    ("roma", "two passes, one way", vgg, "halved", lambda x: functional.avg_pool2d(x, 2)),
    ("roma", "two passes, one way", dense_warp, "resize", nearest),
    ("loma", "detector", dad, "TEMPERATURE", 1.0),
    ("loma", "detector", dad, "MEAN", (0.5, 0.5, 0.5)),
    ("loma", "detector", dad, "resize", lambda x, size, mode: dedode_decoder.resize(x, size, "bilinear")),
    ("loma", "descriptor", dedode_decoder.Refiner, "_hidden", lambda self, mixed: self.hidden_blocks(mixed)),
    ("loma", "matcher", loma_matcher, "turned", lambda x, rotation: x),
    ("loma", "matcher", loma_matcher, "log_scores", lambda similarity: similarity.log_softmax(dim=2)),
    ("aliked", "batch", aliked, "TEMPERATURE", 0.2),
    ("aliked", "batch", aliked, "RADIUS", 3),
    ("aliked", "batch", aliked, "enlarged", nearest),
    ("aliked", "batch", aliked.DescriptorHead, "offsets", no_offsets),
]


@pytest.mark.parametrize(
    ("network", "case", "where", "name", "value"),
    MISTAKES,
    ids=[f"{network} {name}" for network, _, _, name, _ in MISTAKES],
)
def test_a_mistake_is_noticed(network, case, where, name, value, monkeypatch):
    makers = (loma, narrow_roma, aliked_network)
    monkeypatch.setattr(where, name, value)
    for maker in makers:
        maker.cache_clear()
    try:
        with pytest.raises(AssertionError, match=r"is off by"):
            assert_stages(stages_of(CASES, network, case))
    finally:
        for maker in makers:
            maker.cache_clear()


if __name__ == "__main__":
    main(CASES)
