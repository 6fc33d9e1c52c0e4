"""The paper's networks stage by stage against vectors of our own, which need no golden files: see ``vectors``."""

from functools import cache, partial

import numpy as np
import pytest
import torch
from dense import computed
from golden import assert_stages
from semi_dense import traced
from standin import filled, scene, uniform
from torch.nn import functional
from vectors import Found, main, shifted_inputs, stages_of

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer, AspanFormerConfig
from mkpc_kaggle.matchers.networks.assignment import mutual_matches
from mkpc_kaggle.matchers.networks.dense_sampling import (
    SamplingConfig,
    balancing_weights,
    density,
    draw,
    weights_of,
)
from mkpc_kaggle.matchers.networks.dkm import DKM, DkmConfig
from mkpc_kaggle.matchers.networks.loftr import Loftr, LoftrConfig
from mkpc_kaggle.matchers.networks.quadtree import Quadtree, QuadtreeConfig
from mkpc_kaggle.matchers.networks.superglue import (
    ImageKeypoints,
    SuperGlue,
    SuperGlueConfig,
    log_optimal_transport,
)
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint, SuperPointConfig, score_map, suppress_non_maxima


def image_of(pixels):
    return torch.from_numpy(pixels)[None, None, :, :, 0].float() / 255


def shifted_pair(name, size0, size1):
    """Two cuts of one scene: the second begins 8 rows lower and 16 columns further to the left."""
    (h0, w0), (h1, w1) = size0, size1
    whole = scene(max(h0, h1) + 8, max(w0, w1) + 16, name=name)
    return image_of(whole[:h0, 16 : 16 + w0]), image_of(whole[8 : 8 + h1, :w1])


# SuperPoint


def superpoint_values(size, batch=1, **options):
    network = filled(SuperPoint(SuperPointConfig(**options)), "superpoint").eval()
    images = torch.cat([image_of(scene(*size, name=f"picture {index}")) for index in range(batch)])
    features = network.features(images)
    logits = network.logits(features)
    scores = score_map(logits)
    yield "features", features
    yield "logits", logits
    yield "descriptor field", network.descriptor_field(features)
    yield "scores", scores
    yield "suppressed", suppress_non_maxima(scores, network.config.nms_radius).sum(dim=(1, 2))
    for index, found in enumerate(network(images)):
        values = torch.cat([found.scores[:, None], found.descriptors[:, ::32]], dim=1)
        yield f"keypoints {index}", Found(found.points, values)


# SuperGlue


def keypoints(name, count, size, batch=1, like=None):
    """Random keypoints; the first of them, half of ``like``'s at most, describe the same as those do."""
    numbers = torch.from_numpy(uniform(f"{name} points", (batch, count, 3)) / 2 + 0.5).float()
    descriptors = torch.from_numpy(uniform(f"{name} descriptors", (batch, count, 256))).float()
    if like is not None:
        common = min(count, like.points.shape[1]) // 2
        descriptors[:, :common] = like.descriptors[:, :common] * 9 + 0.2 * descriptors[:, :common]
    return ImageKeypoints(
        numbers[..., :2] * torch.tensor(size), numbers[..., 2], functional.normalize(descriptors, dim=2), size
    )


def superglue_values(counts, batch=1, **options):
    network = filled(SuperGlue(SuperGlueConfig(**options)), "superglue")
    image0 = keypoints("first", counts[0], Size(640, 480), batch)
    image1 = keypoints("second", counts[1], Size(480, 600), batch, image0)
    n0 = counts[0]
    yield "positions", network.position(image0)
    x = torch.cat([network.encoded(image0), network.encoded(image1)], dim=1)
    for number, layer in enumerate(network.gnn.layers):
        message = layer.message(x, n0)
        x = layer.update(x, message)
        if number in (0, 1, 2, 17):
            yield f"message {number}", message
            yield f"features {number}", x
    scores = network.score_matrix(network.final_proj(x), n0)
    log_plan = log_optimal_transport(scores, network.bin_score, network.config.sinkhorn_iterations)
    yield "score matrix", scores
    yield "plan", log_plan.exp()
    yield "log plan", log_plan
    found = network(image0, image1)
    assert torch.equal(
        found.matches0, mutual_matches(log_plan[:, :-1, :-1], network.config.match_threshold).matches0
    )
    batches, index0 = torch.nonzero(found.matches0 >= 0, as_tuple=True)
    rows = torch.stack([batches, index0, found.matches0[batches, index0]], dim=1)
    yield "matches", Found(rows, found.scores0[batches, index0, None])


# LoFTR, QuadTree, ASpanFormer

LAYERS = {"loftr": range(8), "quadtree": range(8), "aspanformer": range(4)}


def semi_dense_values(name, network, sizes, masked=False, picture="scene"):
    images = shifted_pair(picture, *sizes)
    masks = None
    if masked:  # two pairs, whose contents end at different cells
        images = tuple(torch.cat([image, image.flip(3)]) for image in images)
        masks = tuple(torch.ones(2, size[0] // 8, size[1] // 8, dtype=torch.bool) for size in sizes)
        masks[0][0, -3:], masks[0][1, :, -2:], masks[1][1, -1:] = False, False, False
    layers = [f"loftr_coarse.layers.{index}" for index in LAYERS[name]]
    initial = ["loftr_coarse.ini_layer"] if name == "aspanformer" else []
    trace = traced(filled(network, name), images, masks, [*initial, *layers])
    for side, maps in enumerate(trace.maps):
        yield f"coarse map {side}", maps.coarse
        yield f"fine map {side}", maps.fine
    for layer in [*initial, *layers]:
        for side, tokens in enumerate(outputs_of(trace.calls[layer])):
            yield f"{layer.removeprefix('loftr_coarse.')} {side}", tokens
    for side, grid in enumerate(trace.grids):
        yield f"transformed {side}", grid
    yield "confidence", trace.confidence
    matches, coarse = trace.matches, trace.matches.coarse
    said = [coarse.confidence[:, None], matches.expectation, matches.points0, matches.points1]
    yield "matches", Found(torch.stack([coarse.batch, coarse.cell0, coarse.cell1], dim=1), torch.cat(said, dim=1))
    for side in (0, 1):
        before, after = trace.windows(side)
        yield f"windows {side}", before
        yield f"fine windows {side}", after


def outputs_of(calls):
    """The features of both images after a layer: two calls, or one that gives both."""
    outputs = [output for _, output in calls]
    for side in outputs[0] if len(outputs) == 1 else outputs:
        yield side if isinstance(side, torch.Tensor) else torch.cat([side.visual, side.flow], dim=-1)


# DKM


@cache
def dkm(*, symmetric):
    return filled(DKM(DkmConfig(symmetric)), "dkm")


def dkm_values(size, fine=None, symmetric=True):
    yield from computed(dkm(symmetric=symmetric), *shifted_inputs(size, fine)).items()


def dkm_sampling_values():
    """From a warp of few values, with noise of ours, for torch may change what its generator gives."""
    warp = torch.from_numpy(uniform("warp", (600, 4))).float()
    certainty = torch.from_numpy(uniform("certainty", (600,)) / 2 + 0.5).float() ** 4
    noise = -torch.from_numpy(np.log(uniform("noise", (2, 600)) / 2 + 0.5)).float()
    weights = weights_of(certainty, SamplingConfig())
    drawn = draw(weights, noise[0], 400)
    yield "weights", weights
    yield "candidates", Found(drawn[:, None], weights[drawn, None])
    crowd = density(warp[drawn] * 0.3)
    yield "density", crowd
    evenness = balancing_weights(crowd)
    yield "evenness", evenness
    samples = draw(evenness, noise[1, :400], 100)
    yield "samples", Found(samples[:, None], evenness[samples, None])


SAME, DIFFERENT = ((96, 128), (96, 128)), ((96, 128), (128, 64))
SMALL, SMALL_DIFFERENT = ((64, 96), (64, 96)), ((64, 96), (96, 64))
CASES = {
    ("superpoint", "default"): partial(superpoint_values, (96, 128)),
    ("superpoint", "outdoor, odd size"): partial(superpoint_values, (75, 101), nms_radius=3, max_keypoints=60),
    ("superpoint", "batch"): partial(superpoint_values, (64, 72), batch=2, remove_borders=0),
    ("superglue", "full"): partial(superglue_values, (60, 47)),
    ("superglue", "outdoor"): partial(superglue_values, (33, 71), sinkhorn_iterations=20),
    ("superglue", "batch"): partial(superglue_values, (20, 26), batch=2),
    ("loftr", "same size"): lambda: semi_dense_values("loftr", Loftr(), SAME),
    ("loftr", "different sizes"): lambda: semi_dense_values(
        "loftr", Loftr(LoftrConfig(fixed_positions=True, border=1)), DIFFERENT
    ),
    ("loftr", "masked batch"): lambda: semi_dense_values("loftr", Loftr(), DIFFERENT, masked=True),
    # Which keys QuadTree keeps is discontinuous: small pictures of which none of the choices is a near tie.
    ("quadtree", "same size"): lambda: semi_dense_values(
        "quadtree", Quadtree(QuadtreeConfig(threshold=0.05)), SMALL, picture="scene 30"
    ),
    ("quadtree", "different sizes"): lambda: semi_dense_values(
        "quadtree",
        Quadtree(QuadtreeConfig(threshold=0.05, topks=(4, 3), border=1)),
        SMALL_DIFFERENT,
        picture="scene 58",
    ),
    ("quadtree", "masked batch"): lambda: semi_dense_values(
        "quadtree", Quadtree(QuadtreeConfig(threshold=0.05, border=0)), SMALL_DIFFERENT, True, "scene 3"
    ),
    ("aspanformer", "same size"): lambda: semi_dense_values("aspanformer", AspanFormer(), SAME),
    ("aspanformer", "different sizes"): lambda: semi_dense_values(
        "aspanformer", AspanFormer(AspanFormerConfig(0.05, coarsest=(4, 4), position_scale=(1.0, 1.0))), DIFFERENT
    ),
    ("aspanformer", "masked batch"): lambda: semi_dense_values(
        "aspanformer", AspanFormer(AspanFormerConfig(0.05)), DIFFERENT, masked=True
    ),
    ("dkm", "one pass"): partial(dkm_values, (64, 80)),
    ("dkm", "two passes, one way"): partial(dkm_values, (61, 83), (90, 118), symmetric=False),
    ("dkm", "sampling"): dkm_sampling_values,
}


@pytest.mark.parametrize(("network", "case"), CASES)
def test_every_stage_is_that_of_the_vectors(network, case):
    assert_stages(stages_of(CASES, network, case))


if __name__ == "__main__":
    main(CASES)
