"""DKM against its golden vectors: the estimates at every stride, and the warp."""

import json
from functools import cache

import pytest
import torch
from dense import (
    batch_of,
    compared,
    computed,
    grey_levels,
    input_of,
    mode_stages,
    pixels_of,
    resized_by_pil,
    within,
)
from golden import GOLDEN, Stage, assert_stages, golden_arrays, needs_golden, ready, seeded_tensor

from mkpc_kaggle.matchers.networks.dense_sampling import balancing_weights, density, draw
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.pixels import network_input


@cache
def standin():
    shapes, gains = (json.loads((GOLDEN / "dkm" / f"{name}.json").read_text()) for name in ("shapes", "gains"))

    def gain(name):
        by_prefix = gains["prefixes"].items()
        return next((gain for prefix, gain in by_prefix if name.startswith(prefix)), gains["default"])

    return {name: seeded_tensor(name, shape, gain(name)) for name, shape in shapes.items()}


@cache
def golden_network():
    return ready(DKM(), standin())


def one_pair(values, *, symmetric=True):
    """The final values shaped as in the golden files of one pair."""
    return values | {
        name: value[0] if symmetric or name.endswith("warp") else value
        for name, value in values.items()
        if name.endswith(("warp", "certainty"))
    }


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
    yield from compared(one_pair(values), golden, within)


def upsample_stages():
    images, golden = golden_arrays("dkm", "main"), golden_arrays("dkm", "upsample")
    coarse, fine = (
        [input_of(images[f"{name}_{size}"]) for name in ("imA", "imB")] for size in ("96x128", "144x192")
    )
    values = computed(golden_network(), coarse, fine)
    yield from compared(one_pair(values), golden, within)


def odd_one_way_stages():
    images, golden = golden_arrays("dkm", "main"), golden_arrays("dkm", "odd_one_way")
    coarse, fine = (
        [input_of(resized_by_pil(images[name], size)) for name in ("imA", "imB")]
        for size in ((90, 118), (130, 170))
    )
    network = golden_network()
    values = computed(network, coarse, symmetric=False) | computed(network, coarse, fine, symmetric=False)
    yield from compared(one_pair(values, symmetric=False), golden, within)


def batched_stages():
    golden = golden_arrays("dkm", "batched")
    pair = golden["query"], golden["support"]
    one_way = computed(golden_network(), pair, symmetric=False)
    values = computed(golden_network(), pair)
    values |= {"one_way_warp": one_way["warp"], "one_way_certainty": one_way["certainty"][:, None]}
    yield from compared(values, golden, within)


def sampling_stages():
    golden, dense = golden_arrays("dkm", "sampling"), golden_arrays("dkm", "main")
    number = int(golden["num"])
    warp, certainty = dense["warp"].reshape(-1, 4), dense["certainty"].flatten()
    yield from mode_stages(warp, certainty, golden, within, number=number, seed=int(golden["seed"]))
    weights = certainty.masked_fill(certainty > 0.05, 1)
    good = draw(weights, golden["noise1"], 4 * number)
    yield Stage("good_index", good, golden["good_index"])
    yield Stage("good_matches", warp[good], golden["good_matches"])
    yield within("good_certainty", weights[good], golden["good_certainty"])
    neighbours = density(golden["good_matches"])
    yield within("density", neighbours, golden["density"])
    balance = balancing_weights(neighbours)
    yield within("balance_p", balance, golden["balance_p"])
    yield Stage("balanced_index", draw(balance, golden["noise2"], number), golden["balanced_index"])
    for key in ("kde_density", "kde_density_exact"):
        yield within(key, density(golden["kde_points"]), golden[key])
    yield from (within(name, got, golden[name]) for name, got in pixels_of(golden))


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
