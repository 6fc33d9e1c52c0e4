"""RoMa and its DINOv2 against their golden vectors: the estimates at every stride, and the warp."""

import json
import re
from functools import cache

import dense
import pytest
import torch
from dense import compared, computed, input_of, mode_stages, pixels_of, resized_by_pil
from golden import GOLDEN, Stage, assert_stages, golden_arrays, needs_golden, ready, seeded_tensor

from mkpc_kaggle.matchers.networks import roma
from mkpc_kaggle.matchers.networks.dense_sampling import balancing_weights, density, draw
from mkpc_kaggle.matchers.networks.grids import as_grid, as_map
from mkpc_kaggle.matchers.networks.roma import RoMa, anchor_mean


def standin():
    """The checkpoints of RoMa and of DINOv2, joined."""
    shapes, gains = (json.loads((GOLDEN / "roma" / f"{name}.json").read_text()) for name in ("shapes", "gains"))

    def gain(part, name):
        prefixes = [prefix for prefix in gains[part]["prefixes"] if name.startswith(prefix)]
        return gains[part]["prefixes"][max(prefixes, key=len)] if prefixes else gains["default"]

    return {
        prefix + name: seeded_tensor(name, shape, gain(part, name))
        for part, prefix in (("dinov2", "dinov2."), ("roma", ""))
        for name, shape in shapes[part].items()
    }


@cache
def golden_network():
    return ready(RoMa(), standin())


def within(name, got, expected):
    looser = re.fullmatch("(.*_)?certainty", name) and "__" not in name
    return dense.within(name, got, expected, 3e-4 if looser else 1e-4)


def main_images():
    golden = golden_arrays("roma", "main")
    return [input_of(golden[key]) for key in ("rsA", "rsB")]


def resized_images(size):
    golden = golden_arrays("roma", "main")
    return [input_of(resized_by_pil(golden[key], size)) for key in ("imA", "imB")]


def main_stages():
    golden = golden_arrays("roma", "main")
    values = computed(golden_network(), main_images())
    yield from compared(values, golden, within)


def upsample_stages():
    golden = golden_arrays("roma", "upsample")
    values = computed(golden_network(), main_images(), resized_images((168, 168)))
    yield from compared(second_pass(values, "warp", "certainty"), golden, within)


def second_pass(values, *plain):
    """The second pass's values alone; ``plain`` are named without "up_" in the file."""
    values = {name: value for name, value in values.items() if name.startswith("up_")}
    return {name.removeprefix("up_") if name[3:] in plain else name: value for name, value in values.items()}


def unequal_one_way_stages():
    golden = golden_arrays("roma", "unequal_one_way")
    images = resized_images((112, 140))
    values = computed(golden_network(), images, symmetric=False)
    values |= second_pass(computed(golden_network(), images, resized_images((150, 202)), symmetric=False))
    yield from compared(values, golden, within)


def batched_stages():
    golden = golden_arrays("roma", "batched")
    pair, high = ([golden[f"{side}{name}"] for side in ("query", "support")] for name in ("", "_high"))
    network = golden_network()
    values = computed(network, pair) | second_pass(computed(network, pair, high))
    forward = computed(network, pair, symmetric=False)
    values |= {f"one_way_{name}": forward[name] for name in ("warp", "certainty")}
    with pytest.MonkeyPatch.context() as patch:  # the release's displacements follow its settings' size
        patch.setattr(roma, "stretch", lambda size: 1.25 * 112 / 560)
        other = computed(network, pair)
    values |= {f"other_setting_{name}": other[name] for name in ("warp", "certainty")}
    yield from compared(values, golden, within)


@torch.inference_mode()
def parts_stages():
    """Positions of DINOv2 at other sizes, and the mean of the best anchor and its neighbours."""
    golden, dinov2 = golden_arrays("roma", "parts"), golden_network().dinov2
    for name in (name for name in golden if name.startswith("pos_")):
        _, size, channels = name.split("_")
        got = dinov2.positions(*map(int, size.split("x")))
        yield within(name, got[..., :: int(channels.removeprefix("ch"))], golden[name])
    logits = seeded_tensor("golden.cls_logits", (2, 4096, 5, 6), 4096 * 30 * 0.25)
    for position, anchor in enumerate(golden["cls_boost_index"].tolist()):
        logits[:, anchor, position // 6, position % 6] += 3
    yield within("cls_flow", as_map(anchor_mean(as_grid(logits))), golden["cls_flow"])


def sampling_stages():
    golden, main = golden_arrays("roma", "sampling"), golden_arrays("roma", "main")
    warp, certainty = main["warp"].reshape(-1, 4), main["certainty"].flatten()
    yield from mode_stages(warp, certainty, golden, within, number=1000, seed=1234, suffix="_float32")
    weights = certainty.masked_fill(certainty > 0.05, 1)
    good = draw(weights, golden["noise1"], 4000)
    yield Stage("good_index", good, golden["good_index"])
    neighbours = density(warp[golden["good_index"]])
    for key in ("density", "density_exact"):
        yield within(key, neighbours, golden[key])
    evenness = balancing_weights(golden["density"])
    yield within("balance_p", evenness, golden["balance_p"])
    yield Stage("balanced_index", draw(evenness, golden["noise2"], 1000), golden["balanced_index"])
    # The release computes densities in half precision, and draws by them what no other device would.
    half = golden["density_half"]
    yield Stage("density_half", neighbours, half, 0.1 * half.max().item())
    yield from (within(name, got, golden[name]) for name, got in pixels_of(golden))


CASES = {
    "main": main_stages,
    "upsample": upsample_stages,
    "unequal_one_way": unequal_one_way_stages,
    "batched": batched_stages,
    "parts": parts_stages,
    "sampling": sampling_stages,
}


@needs_golden
@pytest.mark.parametrize("case", CASES)
def test_every_stage_is_the_golden_one(case):
    assert_stages(CASES[case]())


@needs_golden
def test_the_published_files_have_the_networks_parameters_and_no_others():
    shapes = json.loads((GOLDEN / "roma" / "shapes.json").read_text())
    published = {f"dinov2.{name}": shape for name, shape in shapes["dinov2"].items()} | shapes["roma"]
    with torch.device("meta"):
        network = RoMa()
    assert {name: list(tensor.shape) for name, tensor in network.state_dict().items()} == published
