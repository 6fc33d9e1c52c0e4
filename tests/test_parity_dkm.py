"""DKM stage by stage against its golden vectors; what must hold of any weights; by hand on small maps.

``python tests/test_parity_dkm.py`` prints how far every stage of every case is off.
"""

import json
import re
from collections import defaultdict
from contextlib import contextmanager
from functools import cache

import numpy as np
import pytest
import torch
from golden import GOLDEN, Stage, assert_stages, golden_arrays, needs_golden, print_table, seeded_tensor
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from mkpc_kaggle.geometry.coordinates import Size, from_normalised
from mkpc_kaggle.matchers.networks.dkm import (
    DKM,
    MEAN,
    STD,
    DkmConfig,
    SamplingConfig,
    Weighting,
    balancing_weights,
    dense_warp,
    density,
    draw,
    network_input,
    sample,
    side_by_side,
    swapped,
)
from mkpc_kaggle.matchers.networks.dkm_coarse import kernel, posterior_mean
from mkpc_kaggle.matchers.networks.dkm_refiner import Estimate, identity_map, local_correlation, refined
from mkpc_kaggle.matchers.networks.resnet50 import ResNet50, convolve_and_norm

MODES = {
    "threshold": (Weighting.THRESHOLD, False),
    "threshold_balanced": (Weighting.THRESHOLD, True),
    "pow": (Weighting.CUBE_ROOT, False),
    "pow_balanced": (Weighting.CUBE_ROOT, True),
    "naive": (Weighting.UNIFORM, False),
    "naive_balanced": (Weighting.UNIFORM, True),
    "raw": (Weighting.PLAIN, False),
    "balanced": (Weighting.PLAIN, True),
}


@cache
def standin():
    shapes, gains = (json.loads((GOLDEN / "dkm" / f"{name}.json").read_text()) for name in ("shapes", "gains"))

    def gain(name):
        by_prefix = gains["prefixes"].items()
        return next((gain for prefix, gain in by_prefix if name.startswith(prefix)), gains["default"])

    return {name: seeded_tensor(name, shape, gain(name)) for name, shape in shapes.items()}


@cache
def golden_network(*, symmetric=True):
    network = DKM(DkmConfig(symmetric))
    network.load_state_dict(standin(), strict=True)
    return network


def within(name, got, expected):
    """The tolerance of the golden files: a share of the array's largest value."""
    return Stage(name, got, expected, 1e-4 * expected.abs().max().item())


@contextmanager
def one_thread():
    """As the golden files were made. Their own rounding takes up to 0.7 of the tolerance at stride 1, and how work
    is split among threads changes that of the network by as much again.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def recorded(network):
    """Lists of what modules of the decoder got and gave, by name, and of the estimate after each refiner."""
    calls = defaultdict(list)
    hooks = [
        module.register_forward_hook(lambda _, got, gave, name=name: calls[name].append((got, gave)))
        for name, module in network.decoder.named_modules()
        if re.fullmatch(r"gps\.\d+|embedding_decoder|conv_refiner\.\d+", name)
    ]
    correct = network.decoder.correct

    def recording(estimate, query, support, stride):
        calls[f"estimate.{stride}"].append(correct(estimate, query, support, stride))
        return calls[f"estimate.{stride}"][-1]

    network.decoder.correct = recording
    try:
        yield calls
    finally:
        del network.decoder.correct
        for hook in hooks:
            hook.remove()


@one_thread()
@torch.inference_mode()
def computed(network, images, fine_images=(None, None)):
    """All intermediate values of a pair's match under the golden files' names, "up_" those of the second pass.

    The directions are run one after the other; here they are one batch, as in the golden files.
    """
    first, second = (network.encode(*versions) for versions in zip(images, fine_images, strict=True))
    with recorded(network) as calls:
        dense = side_by_side(network.match(first, second))
    final = "up_" if first.fine else ""
    values = {f"{final}warp": dense.warp, f"{final}certainty": dense.certainty}
    for prefix, versions in (("", images), ("up_", fine_images)):
        if versions[0] is not None:
            pyramids = [network.encoder(image, 8 if prefix else 32) for image in versions]
            values |= {
                f"{prefix}enc{2**i}": torch.cat(levels)
                for i, levels in enumerate(zip(*(pyramid.levels for pyramid in pyramids), strict=True))
            }
    for s in (32, 16):
        query, support = _joined(got for got, _ in calls[f"gps.{s}"])
        flow, certainty, context = _joined(
            (e.flow, e.certainty, z) for (at, *_), (e, z) in calls["embedding_decoder"] if at == s
        )
        x, y = query.flatten(2).mT, support.flatten(2).mT
        values |= {
            f"proj{s}_q": query,
            f"proj{s}_s": support,
            f"pos{s}": network.decoder.gps[str(s)].embed_coordinates(support)[:, ::8],
            f"K{s}_yy": kernel(y, y),
            f"K{s}_xy": kernel(x, y),
            f"gp{s}": torch.cat([gave for _, gave in calls[f"gps.{s}"]]),
            f"dfn{s}_flow": flow,
            f"dfn{s}_cert": certainty,
            f"dfn{s}_ctx": context,
        }
        if s == 32:
            values |= {"flow32": flow, "cert32": certainty}
    for s, refiner in network.decoder.conv_refiner.items():
        passes = ("", "up_") if first.fine and s != "16" else ("",)
        for number, prefix in enumerate(passes):
            refinements = calls[f"conv_refiner.{s}"][number :: len(passes)]
            estimates = calls[f"estimate.{s}"][number :: len(passes)]
            corrections = torch.cat([gave for _, gave in refinements])
            values |= {f"{prefix}ref{s}_dcert": corrections[:, :1], f"{prefix}ref{s}_disp": corrections[:, 1:]}
            if refiner.radius is not None:
                seen = torch.cat([local_correlation(*got, refiner.radius) for got, _ in refinements])
                values[f"{prefix}corr_r{refiner.radius}"] = seen
            flow, certainty = _joined((e.flow, e.certainty) for e in estimates)
            values |= {f"{prefix}flow{s}": flow, f"{prefix}cert{s}": certainty}
    return values


def _joined(calls):
    return [torch.cat(parts) for parts in zip(*calls, strict=True)]


def compared(values, golden):
    """Stages in the order of the network for all arrays of a golden file that ``values`` has."""
    for name, value in values.items():
        for key in golden:
            reduced = re.fullmatch(rf"{name}(?:_ch(\d+))?", key)
            if reduced:
                got = value[:, :: int(reduced[1])] if reduced[1] else value
                if key in {"up_enc2_ch8", "up_ref1_dcert", "up_ref1_disp", "K16_yy", "K16_xy"}:
                    got = got[:1]
                yield within(key, got, golden[key])


STAGES = ("enc", "proj", "pos", "K", "gp", "dfn", "corr", "ref", "flow", "cert", "warp")


def in_order(stages):
    """Along the network: pass by pass and stride by stride; the final values last."""

    def place(stage):
        name = stage.name.removeprefix("up_")
        radius = {"corr_r7": 16, "corr_r3": 8, "corr_r2": 4}.get(name)
        stride = radius or next(map(int, re.findall(r"^[a-zA-Z]+(\d+)", name)), 0)
        kind = next(i for i, prefix in enumerate(STAGES) if name.startswith(prefix))
        return (
            name in {"warp", "certainty"},
            stage.name.startswith("up_"),
            kind > 0,
            -stride if kind else stride,
            kind,
        )

    return sorted(stages, key=place)


def one_pair(values, *, symmetric=True):
    """The final values shaped as in the golden files of one pair."""
    return values | {
        name: value[0] if symmetric or name.endswith("warp") else value
        for name, value in values.items()
        if name.endswith(("warp", "certainty"))
    }


def batch_of(pixels):
    return pixels.permute(2, 0, 1)[None].contiguous()


def input_of(pixels):
    """(H, W, 3) uint8 that has its size already."""
    return network_input(batch_of(pixels), tuple(pixels.shape[:2]))


def resized_by_pil(pixels, size):
    image = pytest.importorskip("PIL.Image", reason="the golden images were resized by PIL")
    resized = image.fromarray(pixels.numpy()).resize(size[::-1], image.Resampling.BICUBIC)
    return torch.from_numpy(np.array(resized))


def grey_levels(image):
    mean, std = (torch.tensor(values)[:, None, None] for values in (MEAN, STD))
    return ((image * std + mean) * 255).round()


def input_stages():
    golden = golden_arrays("dkm", "main")
    for name in ("imA", "imB"):
        for size in ((96, 128), (144, 192)):
            key = f"{name}_{size[0]}x{size[1]}"
            got = grey_levels(network_input(batch_of(golden[name]), size))
            expected = batch_of(golden[key]).float()
            yield Stage(key, got, expected, 1)
            yield Stage(f"{key}, share", (got != expected).float().mean(), torch.tensor(0.0), 0.01)


def main_stages():
    golden = golden_arrays("dkm", "main")
    values = computed(golden_network(), [input_of(golden[f"{name}_96x128"]) for name in ("imA", "imB")])
    yield from exhausted(compared(one_pair(values), golden), golden)


def upsample_stages():
    images, golden = golden_arrays("dkm", "main"), golden_arrays("dkm", "upsample")
    coarse, fine = (
        [input_of(images[f"{name}_{size}"]) for name in ("imA", "imB")] for size in ("96x128", "144x192")
    )
    values = computed(golden_network(), coarse, fine)
    yield from exhausted(compared(one_pair(values), golden), golden)


def odd_one_way_stages():
    images, golden = golden_arrays("dkm", "main"), golden_arrays("dkm", "odd_one_way")
    coarse, fine = (
        [input_of(resized_by_pil(images[name], size)) for name in ("imA", "imB")]
        for size in ((90, 118), (130, 170))
    )
    network = golden_network(symmetric=False)
    values = computed(network, coarse) | computed(network, coarse, fine)
    yield from exhausted(compared(one_pair(values, symmetric=False), golden), golden)


def batched_stages():
    golden = golden_arrays("dkm", "batched")
    pair = golden["query"], golden["support"]
    one_way = computed(golden_network(symmetric=False), pair)
    values = computed(golden_network(), pair) | {
        "one_way_warp": one_way["warp"],
        "one_way_certainty": one_way["certainty"][:, None],
    }
    stages = list(compared({name: values[name] for name in values if not name.startswith("one_way")}, golden))
    stages = list(exhausted(stages, {name: golden[name] for name in golden if not name.startswith("one_way")}))
    yield from stages
    yield from compared({name: values[name] for name in values if name.startswith("one_way")}, golden)


def exhausted(stages, golden):
    """The stages in order; none of the file's floating-point results may be left out."""
    stages = in_order(stages)
    results = {name for name in golden if golden[name].is_floating_point()} - {"query", "support"}
    assert {stage.name for stage in stages} == results
    return stages


def sampling_stages():
    golden, dense = golden_arrays("dkm", "sampling"), golden_arrays("dkm", "main")
    number = int(golden["num"])
    warp, certainty = dense["warp"], dense["certainty"]
    for mode, (weighting, balanced) in MODES.items():
        found = sample(
            warp,
            certainty,
            SamplingConfig(number, weighting, 0.05, balanced),
            torch.Generator().manual_seed(int(golden["seed"])),
        )
        yield Stage(f"{mode}__matches", found.matches, golden[f"{mode}__matches"])
        yield within(f"{mode}__certainty", found.certainty, golden[f"{mode}__certainty"])
    weights = certainty.flatten().masked_fill(certainty.flatten() > 0.05, 1)
    good = draw(weights, golden["noise1"], 4 * number)
    yield Stage("good_index", good, golden["good_index"])
    yield Stage("good_matches", warp.reshape(-1, 4)[good], golden["good_matches"])
    yield within("good_certainty", weights[good], golden["good_certainty"])
    neighbours = density(golden["good_matches"])
    yield within("density", neighbours, golden["density"])
    balance = balancing_weights(neighbours)
    yield within("balance_p", balance, golden["balance_p"])
    yield Stage("balanced_index", draw(balance, golden["noise2"], number), golden["balanced_index"])
    for key in ("kde_density", "kde_density_exact"):
        yield within(key, density(golden["kde_points"]), golden[key])
    height0, width0, height1, width1 = golden["pixel_sizes_HA_WA_HB_WB"].tolist()
    sides = golden["pixel_in"].numpy().reshape(-1, 2, 2).swapaxes(0, 1)
    sizes = Size(width0, height0), Size(width1, height1)
    for name, points, size in zip(("pixel_A", "pixel_B"), sides, sizes, strict=True):
        got = torch.from_numpy(from_normalised(points, size))
        yield within(name, got + 0.5, golden[name])  # theirs have pixel centres at halves


CASES = {
    "input": input_stages,
    "main": main_stages,
    "upsample": upsample_stages,
    "odd_one_way": odd_one_way_stages,
    "batched": batched_stages,
    "sampling": sampling_stages,
}


@needs_golden
@pytest.mark.parametrize("case", CASES)
def test_every_stage_is_the_golden_one(case):
    assert_stages(CASES[case]())


@cache
def network(*, symmetric=True):
    """Random weights that keep activations, and so the flow, of order 1."""
    torch.manual_seed(0)
    network = DKM(DkmConfig(symmetric))
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.ndim > 1:
                parameter.normal_(std=parameter[0].numel() ** -0.5)
    return network


def images(count, height, width, seed=0):
    """Normalised noise with some texture at all scales."""
    generator = torch.Generator().manual_seed(seed)
    layers = [
        functional.interpolate(torch.randn(count, 3, n, n, generator=generator), (height, width), mode="bicubic")
        for n in (2, 5, 17)
    ]
    return sum(layers)


def features(count=1, size=(45, 61), fine=None, seed=0):
    return network().encode(images(count, *size, seed), None if fine is None else images(count, *fine, seed))


def test_the_parameters_are_those_of_the_checkpoint():
    state = network().state_dict()
    assert len(state) == 813
    assert sum(parameter.numel() for parameter in network().parameters()) == 72_261_090


@torch.inference_mode()
@pytest.mark.parametrize("fine", [None, (70, 83)])
def test_a_batch_finds_what_its_pairs_give_alone(fine):
    query, support = features(2, fine=fine), features(2, fine=fine, seed=1)
    found = side_by_side(network().match(query, support))
    for i in range(2):
        alone = [
            network().encode(
                images(2, 45, 61, seed)[i : i + 1], None if fine is None else images(2, *fine, seed)[i : i + 1]
            )
            for seed in (0, 1)
        ]
        expected = side_by_side(network().match(*alone))
        torch.testing.assert_close(found.warp[i], expected.warp[0], rtol=0, atol=1e-3)
        # A pixel within rounding of the border may count as outside in one of them.
        off = (found.certainty[i] - expected.certainty[0]).abs() > 1e-3
        assert off.float().mean() < 1e-3


@torch.inference_mode()
def test_a_symmetric_match_holds_both_one_way_matches():
    first, second = features(), features(size=(38, 52), seed=1)
    both = network().match(first, second)
    ((there,), (back,)) = (network(symmetric=False).match(*pair) for pair in ((first, second), (second, first)))
    assert len(both) == 2
    assert torch.equal(both[0].warp, there.warp)
    assert torch.equal(both[1].warp, back.warp[..., [2, 3, 0, 1]])
    assert torch.equal(both[0].certainty, there.certainty)
    assert torch.equal(both[1].certainty, back.certainty)


@torch.inference_mode()
def test_the_warp_is_in_range_and_its_query_side_the_identity():
    (found,) = network(symmetric=False).match(features(fine=(70, 83)), features(fine=(70, 83), seed=1))
    assert found.warp.shape == (1, 70, 83, 4)
    assert found.certainty.shape == (1, 70, 83)
    assert found.warp.abs().max() <= 1
    assert (found.certainty >= 0).all()
    assert (found.certainty <= 1).all()
    assert 0 < (found.certainty == 0).float().mean() < 1  # both kinds of target occur
    assert found.warp[..., 2:].std() > 0.1
    torch.testing.assert_close(found.warp[0, 3, 5, :2], torch.tensor([11 / 83 - 1, 7 / 70 - 1]))


@torch.inference_mode()
@pytest.mark.parametrize("fine", [False, True])
@pytest.mark.parametrize("sizes", [((1, 1), (2, 3)), ((5, 70), (1, 1)), ((33, 32), (33, 32)), ((90, 4), (31, 40))])
def test_any_two_sizes_go_through(sizes, fine):
    larger = [(2 * h, w + 5) if fine else None for h, w in sizes]
    pair = (
        features(size=size, fine=full, seed=i) for i, (size, full) in enumerate(zip(sizes, larger, strict=True))
    )
    found = network().match(*pair)
    expected = larger if fine else sizes
    assert [dense.warp.shape for dense in found] == [(1, *size, 4) for size in expected]
    assert [dense.certainty.shape for dense in found] == [(1, *size) for size in expected]
    assert all(part.isfinite().all() for dense in found for part in (dense.warp, dense.certainty))


@torch.inference_mode()
def test_sides_are_halved_upwards_and_only_as_far_as_asked():
    image = images(1, 45, 61)
    levels = network().encoder(image).levels
    sizes = [tuple(level.shape[1:]) for level in levels]
    expected = [(3, 45, 61), (64, 23, 31), (256, 12, 16), (512, 6, 8), (1024, 3, 4), (2048, 2, 2)]
    assert sizes == expected
    fine = network().encoder(image, 8).levels
    assert [level.shape for level in fine] == [level.shape for level in levels[:4]]
    assert all(torch.equal(a, b) for a, b in zip(fine, levels, strict=False))


def test_a_second_pass_needs_both_images():
    with pytest.raises(ValueError, match="either both images or neither"):
        network().match(features(), features(fine=(70, 83)))


@torch.inference_mode()
def test_what_the_support_shows_beside_the_query_moves_the_corrections_in_its_own_pixels():
    """A refiner that sees the same things corrects by the same pixels, however large the support is."""
    refiner = network().decoder.conv_refiner["8"]
    generator = torch.Generator().manual_seed(5)
    query, support = torch.randn(2, 1, 512, 6, 8, generator=generator)
    larger = functional.pad(support, (0, 8, 0, 3))  # 9 x 16: as zero beside the support as outside it
    in_pixels = torch.rand(1, 2, 6, 8, generator=generator) * 5
    corrected, embedded = [], []
    for seen in (support, larger):
        height, width = seen.shape[2:]
        size = torch.tensor([width, height])[:, None, None]
        flow = (2 * in_pixels + 1) / size - 1
        look = refiner._look(query, seen, flow)
        embedded.append(torch.cat([look[:, : 2 * 512], look[:, 2 * 512 + 64 :]], dim=1))
        estimate = Estimate(flow, torch.zeros(1, 1, 6, 8))
        found = refined(estimate, torch.ones(1, 3, 6, 8), 8, torch.Size([8 * height, 8 * width]))
        corrected.append((found.flow - flow) * size / 2)  # in the support's pixels at this stride
    torch.testing.assert_close(embedded[0], embedded[1], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(corrected[0], torch.full((1, 2, 6, 8), 1 / 8))
    torch.testing.assert_close(corrected[1], corrected[0], rtol=1e-4, atol=1e-5)


@torch.inference_mode()
def test_the_posterior_knows_where_in_a_support_of_another_size_a_pixel_is():
    gp = network().decoder.gps["16"]
    support = torch.randn(1, 512, 5, 9, generator=torch.Generator().manual_seed(6))
    query = support[:, :, 2:4, 3:6]  # a cut-out: each pixel is its own in the support
    posterior, coordinates = gp(query, support), gp.embed_coordinates(support)
    expected = coordinates[:, :, 2:4, 3:6]
    assert posterior.shape == (1, 256, 2, 3)
    assert functional.cosine_similarity(posterior, expected).min() > 0.99


@torch.inference_mode()
@pytest.mark.parametrize(("bias", "groups", "stride"), [(True, 6, 1), (False, 1, 2)])
def test_the_norm_goes_into_the_weights(bias, groups, stride):
    torch.manual_seed(1)
    conv = torch.nn.Conv2d(6, 12, 3, stride, 1, groups=groups, bias=bias)
    norm = torch.nn.BatchNorm2d(12).eval()
    for tensor in (norm.weight, norm.bias, norm.running_mean):
        tensor.normal_()
    norm.running_var.uniform_(0.1, 2)
    x = torch.randn(2, 6, 9, 8)
    torch.testing.assert_close(convolve_and_norm(conv, norm, x), norm(conv(x)), rtol=1e-5, atol=1e-5)


@torch.inference_mode()
def test_a_bottleneck_is_its_definition():
    torch.manual_seed(2)
    block = ResNet50().eval().layer2[0]
    x = torch.randn(1, 256, 7, 9)
    y = functional.relu(block.bn1(block.conv1(x)))
    y = functional.relu(block.bn2(block.conv2(y)))
    expected = functional.relu(block.bn3(block.conv3(y)) + block.downsample(x))
    torch.testing.assert_close(block(x), expected, rtol=1e-5, atol=1e-5)
    assert block.conv2.stride == (2, 2)


@given(
    radius=st.integers(1, 4),
    size=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    support_size=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    spread=st.sampled_from([0.5, 1.5, 20]),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=50, deadline=None)
def test_local_correlation_is_its_definition(radius, size, support_size, spread, seed):
    generator = torch.Generator().manual_seed(seed)
    h, w = support_size
    query = torch.randn(2, 5, *size, generator=generator)
    support = torch.randn(2, 5, h, w, generator=generator)
    flow = torch.randn(2, 2, *size, generator=generator) * spread
    offsets = [(a, b) for a in range(-radius, radius + 1) for b in range(-radius, radius + 1)]
    expected = []
    for a, b in offsets:
        target = flow.permute(0, 2, 3, 1) + torch.tensor([2 * b / w, 2 * a / h])
        expected.append((query * functional.grid_sample(support, target, align_corners=False)).sum(1) / 5**0.5)
    got = local_correlation(query, support, flow, radius)
    torch.testing.assert_close(got, torch.stack(expected, dim=1), rtol=1e-4, atol=2e-4)


def test_local_correlation_is_the_same_in_several_blocks():
    torch.manual_seed(3)
    query, support = torch.randn(2, 1, 512, 12, 16)  # 32 pixels a block
    flow = torch.randn(1, 2, 12, 16)
    got = local_correlation(query, support, flow, 3)
    pixel = got[0, :, 7, 11]
    target = flow[0, :, 7, 11] * 1.0
    window = torch.stack(
        [target + torch.tensor([2 * b / 16, 2 * a / 12]) for a in range(-3, 4) for b in range(-3, 4)]
    )
    sampled = functional.grid_sample(support, window[None, None], align_corners=False)[0, :, 0]  # (512, 49)
    torch.testing.assert_close(pixel, query[0, :, 7, 11] @ sampled / 512**0.5, rtol=1e-4, atol=1e-4)


def test_the_posterior_is_that_of_the_textbook():
    torch.manual_seed(4)
    x, y, values = torch.randn(2, 7, 16), torch.randn(2, 11, 16), torch.randn(1, 11, 3)

    def k(a, b):
        a, b = a.double(), b.double()
        return ((functional.normalize(a, dim=2) @ functional.normalize(b, dim=2).mT - 1) / 0.2).exp()

    inverse = torch.linalg.inv(k(y, y) + 0.1 * torch.eye(11))
    expected = k(x, y) @ inverse @ values.double()
    torch.testing.assert_close(posterior_mean(x, y, values).double(), expected, rtol=1e-4, atol=1e-5)


def test_a_unit_of_correction_is_an_eighth_of_a_pixel_of_its_stride():
    estimate = Estimate(torch.zeros(1, 2, 5, 9), torch.ones(1, 1, 5, 9))
    corrections = torch.tensor([3.0, 8.0, 16.0])[None, :, None, None].expand(1, 3, 5, 9)
    found = refined(estimate, corrections, 4, torch.Size([20, 36]))
    torch.testing.assert_close(found.flow[0, :, 0, 0], torch.tensor([2 / 9, 2 * 2 / 5]))
    assert (found.certainty == 4).all()


def test_targets_outside_have_no_certainty_and_coarse_doubts_count_half():
    flow = torch.zeros(1, 2, 2, 2)
    flow[0, 0, 0, 1], flow[0, 1, 1, 0], flow[0, :, 1, 1] = 1.001, -2, 1
    found = dense_warp(Estimate(flow, torch.full((1, 1, 2, 2), -1.0)), torch.full((1, 1, 1, 1), -3.0))
    raised = torch.tensor(0.5).sigmoid()
    torch.testing.assert_close(found.certainty[0], raised * torch.tensor([[1, 0], [0, 1]]))
    assert found.warp[0, ..., 2:].tolist() == [[[0, 0], [1, 0]], [[0, -1], [1, 1]]]
    assert found.warp[0, ..., :2].tolist() == [[[-0.5, -0.5], [0.5, -0.5]], [[-0.5, 0.5], [0.5, 0.5]]]
    sure = dense_warp(Estimate(flow, torch.full((1, 1, 2, 2), -1.0)), torch.full((1, 1, 1, 1), 3.0))
    torch.testing.assert_close(sure.certainty[0, 0, 0], torch.tensor(-1.0).sigmoid())
    both = side_by_side((found, swapped(sure)))
    assert torch.equal(both.warp[0, 0, 3], torch.tensor([1, 0, 0.5, -0.5]))


def test_pixel_centres():
    assert identity_map(torch.zeros(1, 4))[0].tolist() == [[[-0.75, -0.25, 0.25, 0.75]], [[0, 0, 0, 0]]]


def warp_and_certainty(count=3000, seed=5):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 4, generator=generator) * 2 - 1, torch.rand(count, generator=generator) ** 4


@pytest.mark.parametrize("mode", MODES)
def test_samples_repeat_with_a_seed_and_hold_no_match_twice(mode):
    weighting, balanced = MODES[mode]
    warp, certainty = warp_and_certainty()
    config = SamplingConfig(400, weighting, balanced=balanced)
    first, again, other = (
        sample(warp, certainty, config, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)
    )
    assert torch.equal(first.matches, again.matches)
    assert torch.equal(first.certainty, again.certainty)
    assert not torch.equal(first.matches, other.matches)
    assert len(first.matches.unique(dim=0)) == 400
    folded = sample(warp.view(2, 30, 50, 4), certainty.view(2, 30, 50), config, torch.Generator().manual_seed(1))
    assert torch.equal(folded.matches, first.matches)


def test_without_balance_it_is_pytorchs_multinomial():
    warp, certainty = warp_and_certainty()
    drawn = torch.multinomial(certainty, 50, generator=torch.Generator().manual_seed(6))
    config = SamplingConfig(50, Weighting.PLAIN, balanced=False)
    found = sample(warp, certainty, config, torch.Generator().manual_seed(6))
    assert torch.equal(found.matches, warp[drawn])
    assert torch.equal(found.certainty, certainty[drawn])


def test_balancing_spreads_the_matches():
    generator = torch.Generator().manual_seed(7)
    crowd = torch.rand(9000, 4, generator=generator) * 0.1
    thin = torch.rand(1000, 4, generator=generator) * 0.1 - 0.9
    warp, certainty = torch.cat([crowd, thin]), torch.ones(10000)
    shares = [
        (sample(warp, certainty, SamplingConfig(500, balanced=balanced), generator).matches[:, 0] < 0)
        .float()
        .mean()
        .item()
        for balanced in (False, True)
    ]
    assert shares[0] == pytest.approx(0.1, abs=0.06)
    assert shares[1] > 0.3


def test_what_has_no_weight_is_not_drawn():
    warp, certainty = warp_and_certainty(100)
    certainty[10:] = 0
    found = sample(warp, certainty, SamplingConfig(50))
    assert sorted(found.matches.tolist()) == sorted(warp[:10].tolist())
    assert len(sample(warp, certainty * 0, SamplingConfig(50)).matches) == 0
    assert len(sample(warp[:0], certainty[:0], SamplingConfig(50)).matches) == 0


def test_sampling_refuses_what_makes_no_sense():
    warp, certainty = warp_and_certainty(100)
    with pytest.raises(ValueError, match="finite"):
        sample(warp, certainty.index_fill(0, torch.tensor([3]), float("nan")), SamplingConfig(50))
    with pytest.raises(ValueError, match="number"):
        SamplingConfig(0)


def test_density_is_its_definition_in_several_blocks():
    points, _ = warp_and_certainty(3000)
    exact = torch.exp(-torch.cdist(points.double(), points.double()).square() / 0.02).sum(dim=1)
    torch.testing.assert_close(density(points).double(), exact, rtol=1e-4, atol=1e-4)
    weights = balancing_weights(torch.tensor([1.0, 9.99, 10.0, 99.0]))
    torch.testing.assert_close(weights, torch.tensor([1e-7, 1e-7, 1 / 11, 0.01]))


def test_the_input_is_normalised_and_of_its_size():
    pixels = torch.randint(0, 256, (2, 3, 8, 9), dtype=torch.uint8)
    image = network_input(pixels, (8, 9))
    expected = (pixels[1, 2, 3, 4] / 255 - 0.406) / 0.225
    torch.testing.assert_close(image[1, 2, 3, 4], expected)
    assert network_input(pixels, (20, 7)).shape == (2, 3, 20, 7)


def test_the_input_is_resized_as_by_pil():
    rng = np.random.default_rng(8)
    pixels = torch.from_numpy(rng.integers(0, 256, (150, 210, 3), dtype=np.uint8))
    for size in ((64, 80), (170, 333)):
        got = grey_levels(network_input(batch_of(pixels), size))
        off = (got - batch_of(resized_by_pil(pixels, size))).abs()
        assert off.max() <= 1
        assert off.mean() < 0.02


if __name__ == "__main__":
    print_table("dkm", [(case, stages()) for case, stages in CASES.items()])
