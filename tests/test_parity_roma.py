"""RoMa and its DINOv2 stage by stage against their golden vectors.

``python tests/test_parity_roma.py`` prints how far every stage of every case is off.
"""

import json
import re
from functools import cache

import pytest
import torch
from dense import batch_of, one_thread
from golden import (
    GOLDEN,
    Stage,
    assert_stages,
    golden_arrays,
    needs_golden,
    print_table,
    ready,
    recorded,
    seeded_tensor,
)

from mkpc_kaggle.matchers.networks.dinov2 import DinoV2
from mkpc_kaggle.matchers.networks.dkm import network_input


@cache
def standin(part):
    """The checkpoint of RoMa or of DINOv2."""
    shapes, gains = (json.loads((GOLDEN / "roma" / f"{name}.json").read_text()) for name in ("shapes", "gains"))

    def gain(name):
        prefixes = [prefix for prefix in gains[part]["prefixes"] if name.startswith(prefix)]
        return gains[part]["prefixes"][max(prefixes, key=len)] if prefixes else gains["default"]

    return {name: seeded_tensor(name, shape, gain(name)) for name, shape in shapes[part].items()}


@cache
def golden_dinov2():
    return ready(DinoV2(), standin("dinov2"))


def within(name, got, expected):
    """The tolerance of the golden files: a share of the array's largest value."""
    share = 3e-4 if name.endswith("certainty") else 1e-4
    return Stage(name, got, expected, share * expected.abs().max().item())


def compared(values, golden):
    """Stages in the order of the network for all arrays of a golden file that ``values`` has.

    Of some batches the file has the first item only.
    """
    for name, value in values.items():
        for key in golden:
            reduced = re.fullmatch(rf"{name}(?:_ch(\d+))?", key)
            if reduced:
                step = int(reduced[1] or 1)
                got = value[..., ::step] if value.ndim == 3 else value[:, ::step]
                yield within(key, got[: len(golden[key])], golden[key])


def images_of(name="main"):
    golden = golden_arrays("roma", name)
    return [network_input(batch_of(golden[key]), golden[key].shape[:2]) for key in ("rsA", "rsB")]


@one_thread()
@torch.inference_mode()
def dinov2_values(images):
    """All values on the way to the features, by the names of the golden files."""
    network = golden_dinov2()
    blocks = {f"blocks.{number - 1}": f"dino_block{number}" for number in (1, 12, 24)}
    with recorded(network, ["patch_embed.proj", "norm", *blocks]) as calls:
        network(torch.cat(images))
    outputs = {name: calls_of[0][1] for name, calls_of in calls.items()}
    h, w = outputs["patch_embed.proj"].shape[2:]
    return (
        {"dino_patch": outputs["patch_embed.proj"].flatten(2).mT, f"pos_{h}x{w}": network.positions(h, w)}
        | {name: outputs[block] for block, name in blocks.items()}
        | {"dino_norm": outputs["norm"]}
    )


def dinov2_stages():
    golden = golden_arrays("roma", "main")
    yield from compared(dinov2_values(images_of()), golden)


@torch.inference_mode()
def parts_stages():
    golden, network = golden_arrays("roma", "parts"), golden_dinov2()
    grids = ((40, 40), (37, 37), (5, 6), (40, 30))
    values = {f"pos_{h}x{w}": network.positions(h, w) for h, w in grids}
    values |= {"small_dino_block1": network.blocks[0](golden["small_tokens"])}
    values |= {"small_dino_norm": network.norm(golden["small_tokens"])}
    yield from compared(values, golden)


CASES = {"dinov2": dinov2_stages, "parts": parts_stages}


@needs_golden
@pytest.mark.parametrize("case", CASES)
def test_every_stage_is_the_golden_one(case):
    assert_stages(CASES[case]())


if __name__ == "__main__":
    print_table("roma", [(case, stages()) for case, stages in CASES.items()])
