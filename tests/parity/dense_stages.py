"""DKM and RoMa against golden files: the estimates at every stride, the warp, and the matches drawn
from it.
"""

import json
from functools import cache, partial

import numpy as np
import PIL.Image
import pytest
import torch
from golden import (
    GOLDEN,
    Stage,
    Within,
    compared,
    golden_arrays,
    in_order,
    ready,
    seeded_tensor,
)

from mkpc_kaggle.matchers.networks.dense_sampling import (
    sample_matches,
)
from mkpc_kaggle.matchers.networks.dense_warp import dense_warp
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.pixels import network_input
from mkpc_kaggle.matchers.networks.roma import RoMa

# Of sampling, by the golden files' names: the threshold
MODES = {"threshold_balanced": 0.05, "balanced": 1.0}


def state_of(shapes, gains, default, prefix=""):
    state = {}
    for name, shape in shapes.items():
        # Of several prefixes that fit, the longest has the gain.
        fitting = [start for start in gains if name.startswith(start)]
        gain = gains[max(fitting, key=len)] if fitting else default
        state[prefix + name] = seeded_tensor(name, shape, gain)
    return state


@cache
def network_of(name):
    shapes = json.loads((GOLDEN / name / "shapes.json").read_text())
    gains = json.loads((GOLDEN / name / "gains.json").read_text())
    default = gains["default"]
    if name == "dkm":
        return ready(DKM(), state_of(shapes, gains["prefixes"], default))
    # RoMa's checkpoint has no DINOv2, which is a separate file.
    dinov2 = state_of(shapes["dinov2"], gains["dinov2"]["prefixes"], default, "dinov2.")
    roma = state_of(shapes["roma"], gains["roma"]["prefixes"], default)
    return ready(RoMa(), dinov2 | roma)


@cache
def tolerances_of(name):
    certainty = {"dkm": 1e-4, "roma": 3e-4}[name]
    return {"(?!.*__)(.*_)?certainty": Within(share=certainty), "": Within(share=1e-4)}


def computed(name, images, fine_images=(None, None), *, symmetric=True):
    """Return estimates at all strides and the final warp, by the golden files' names; "up_" in the
    second pass.

    The golden networks run the directions one after the other. Here they are one batch.
    """
    network = network_of(name)
    features = [
        network.encode(*versions) for versions in zip(images, fine_images, strict=True)
    ]
    correct = network.decoder.correct
    found = {stride: [] for stride in network.decoder.conv_refiner}

    def recording(estimate, query, support, stride):
        corrected = correct(estimate, query, support, stride)
        found[str(stride)].append(corrected)
        return corrected

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(network.decoder, "correct", recording)
        one_way = () if symmetric else (dense_warp(*network.decoder(*features)),)
        warps = one_way or network.match(*features)
    passes = ("",) if fine_images[0] is None else ("", "up_")
    values = {}
    for number, prefix in enumerate(passes):
        for stride, estimates in found.items():
            if stride == "16" and prefix:
                continue  # the second pass begins at stride 8
            of_pass = estimates if stride == "16" else estimates[number :: len(passes)]
            flows = [estimate.flow for estimate in of_pass]
            certainties = [estimate.certainty for estimate in of_pass]
            values[f"{prefix}flow{stride}"] = torch.cat(flows)
            values[f"{prefix}cert{stride}"] = torch.cat(certainties)
    for part in ("warp", "certainty"):
        values[f"{passes[-1]}{part}"] = torch.cat([getattr(warp, part) for warp in warps], 2)
    return values


def dense_stages(name, case, values):
    """Compare all values that a golden file has; of some batches it has the first item only."""
    golden = golden_arrays(name, case)
    shown = {key: value[: len(golden[key])] for key, value in values.items() if key in golden}
    # The result itself is among them: names that do not agree would compare nothing.
    assert any(key.endswith("warp") for key in shown)
    assert any(key.endswith("certainty") for key in shown)
    yield from compared(shown, golden, tolerances_of(name))


def second_pass(values, *plain):
    """Return the second pass's values alone; ``plain`` are named without "up_" in the file."""
    found = {}
    for name, value in values.items():
        if name.startswith("up_"):
            own = name.removeprefix("up_")
            found[own if own in plain else name] = value
    return found


def batch_of(pixels):
    return pixels.permute(2, 0, 1)[None].contiguous()


def resized_by_pil(pixels, size):
    # The references resize with Pillow, whose bicubic filter is antialiased and torch's is not.
    image = PIL.Image.fromarray(pixels.numpy())
    resized = image.resize(size[::-1], PIL.Image.Resampling.BICUBIC)
    return torch.from_numpy(np.array(resized))


def images_of(name, *keys, size=None):
    """Return pictures of the file "main" as the network's input, resized if a size (H, W) is given."""
    golden = golden_arrays(name, "main")
    pictures = [resized_by_pil(golden[key], size) if size else golden[key] for key in keys]
    return [network_input(batch_of(pixels), tuple(pixels.shape[:2])) for pixels in pictures]


def dkm_upsample():
    coarse = images_of("dkm", "imA_96x128", "imB_96x128")
    fine = images_of("dkm", "imA_144x192", "imB_144x192")
    return computed("dkm", coarse, fine)


def dkm_one_way():
    # Sides that are not multiples of a stride: grids are rounded up.
    coarse = images_of("dkm", "imA", "imB", size=(90, 118))
    fine = images_of("dkm", "imA", "imB", size=(130, 170))
    first = computed("dkm", coarse, symmetric=False)
    return first | computed("dkm", coarse, fine, symmetric=False)


def roma_upsample():
    coarse = images_of("roma", "rsA", "rsB")
    fine = images_of("roma", "imA", "imB", size=(168, 168))
    return second_pass(computed("roma", coarse, fine), "warp", "certainty")


def roma_one_way():
    images = images_of("roma", "imA", "imB", size=(112, 140))
    high = images_of("roma", "imA", "imB", size=(150, 202))
    values = computed("roma", images, symmetric=False)
    return values | second_pass(computed("roma", images, high, symmetric=False))


def sampling_stages(name, suffix=""):
    golden = golden_arrays(name, "sampling")
    main = golden_arrays(name, "main")
    number = int(golden.get("num", 1000))
    seed = int(golden.get("seed", 1234))
    warp = main["warp"].reshape(-1, 4)
    certainty = main["certainty"].flatten()
    for mode, threshold in MODES.items():
        generator = torch.Generator().manual_seed(seed)
        index = sample_matches(warp, certainty, number, threshold, generator)
        weights = certainty.masked_fill(certainty > threshold, 1)
        # Rounding orders near ties of the second draw. The set of its matches is 3.5e-4 from
        # another one, and rounding changes weights by 1e-5.
        got = in_order(torch.column_stack((warp[index], weights[index])))
        parts = [golden[f"{mode}{suffix}__{part}"] for part in ("matches", "certainty")]
        expected = in_order(torch.column_stack(parts))
        yield Stage(f"{mode}__matches", got, expected, Within(relative=1e-4))


VALUES = {  # by network and golden file
    ("dkm", "main"): lambda: computed("dkm", images_of("dkm", "imA_96x128", "imB_96x128")),
    ("dkm", "upsample"): dkm_upsample,
    ("dkm", "odd_one_way"): dkm_one_way,
    ("roma", "main"): lambda: computed("roma", images_of("roma", "rsA", "rsB")),
    ("roma", "upsample"): roma_upsample,
    ("roma", "unequal_one_way"): roma_one_way,
}
CASES = {
    f"{name} {case}": lambda name=name, case=case, make=make: dense_stages(name, case, make())
    for (name, case), make in VALUES.items()
}
CASES["dkm sampling"] = partial(sampling_stages, "dkm")
CASES["roma sampling"] = partial(sampling_stages, "roma", "_float32")
