"""LoFTR, QuadTree and ASpanFormer against golden files: grids, confidences and matches."""

import json
import re
from dataclasses import replace
from functools import cache, partial

import torch
from golden import (
    GOLDEN,
    Within,
    compared,
    golden_arrays,
    ready,
    recorded,
    seeded_tensor,
    standin_state,
)

from mkpc_kaggle.matchers.adapters.aspanformer import SPEC
from mkpc_kaggle.matchers.contract import Training
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer, AspanTransformer
from mkpc_kaggle.matchers.networks.coarse_matching import Cells, half_log_confidences
from mkpc_kaggle.matchers.networks.fine_matching import COARSE_STRIDE, cell_points
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.quadtree import Quadtree

# QuadTree's cells and ASpanFormer's positions depend on computed values: rounding adds up.
LOFTR = {"coarse": 1e-4, "conf": 1e-4, "mconf": 1e-4, "mkpts1_f": 5e-4}
QUADTREE = {"coarse": 1e-4, "conf": 2e-4, "mconf": 2e-4, "mkpts1_f": 2e-3}
ASPANFORMER = {"coarse": 1e-4, "m?conf": Within(1e-6, relative=2e-3), "mkpts": 1e-2}


def confidence_of(network, grid0, grid1, masks):
    """Return the full confidence matrix (1, L, S) of grids (1, h, w, 256)."""
    masks = masks or [torch.ones(grid.shape[:3], dtype=torch.bool) for grid in (grid0, grid1)]
    features0 = (grid0 * network.similarity_scale).flatten(0, 2)
    features1 = grid1.flatten(0, 2)
    cells = Cells(features0, features1, *(mask.flatten() for mask in masks))
    return torch.cat(list(half_log_confidences(cells)))[None].mul(2).exp()


def computed(network, images, masks, scales, coarse_scales=None):
    """Return what all stages compute of images (N, 1, H, W), by name.

    Points are multiplied by ``scales`` (N, 2) of either side, coarse ones by ``coarse_scales`` if
    given.
    """
    given = images, masks, scales, coarse_scales
    found = []
    # The package matches one pair at a time; the references had batches.
    for number in range(len(images[0])):
        of_pair = (both and [each[number : number + 1] for each in both] for both in given)
        found.append(computed_of_pair(network, *of_pair))
        found[-1]["b_ids"] = torch.full_like(found[-1]["i_ids"], number)
    return {name: torch.cat([values[name] for values in found]) for name in found[0]}


def computed_of_pair(network, images, masks, scales, coarse_scales):
    maps = [network.encode(image) for image in images]
    with recorded(network, "loftr_coarse") as calls:
        matches = network.match(*maps, masks)
    transformed = zip(calls[0][1], maps, strict=True)
    grids = [
        tokens.reshape(len(tokens), *own.coarse.shape[2:], 256) for tokens, own in transformed
    ]
    coarse = matches.coarse
    confidence = confidence_of(network, *grids, masks)
    values = {
        "conf": confidence,
        "conf_rowmax": confidence.amax(2),
        "conf_colmax": confidence.amax(1),
        "i_ids": coarse.index0,
        "j_ids": coarse.index1,
        "mconf": coarse.scores,
    }
    for side, grid in enumerate(grids):
        points = cell_points((coarse.index0, coarse.index1)[side], grid.shape[2])
        values[f"coarse{side}"] = grid.flatten(1, 2)
        values[f"mkpts{side}_c"] = points * (coarse_scales or scales)[side]
        values[f"mkpts{side}_f"] = (matches.points0, matches.points1)[side] * scales[side]
    return values


def masks_and_scales(golden):
    if "mask0" not in golden:
        return None, [torch.ones(1, 2)] * 2
    return (golden["mask0"], golden["mask1"]), (golden["scale0"], golden["scale1"])


@cache
def standin(network):
    """QuadTree's coarse level computes in float64: in float32 rounding decides near ties of its key
    cells.
    """
    made = ready(network(), standin_state(network.__name__.lower()))
    if network is Quadtree:
        made.backbone.double()
        made.loftr_coarse.double()
        made.fine_preprocess.register_forward_pre_hook(
            lambda _, given: tuple(part.float() for part in given)
        )
    return made


def loftr_stages(network, case, tolerances):
    golden = golden_arrays(network.__name__.lower(), case)
    kind = torch.float64 if network is Quadtree else torch.float32
    images = [golden[f"image{side}_u8"].to(kind)[:, None] / 255 for side in (0, 1)]
    values = computed(standin(network), images, *masks_and_scales(golden))
    values["conf_rows"] = values["conf"][:, ::7]
    for side in ("coarse0", "coarse1"):
        # The files keep every second or fourth channel.
        values[side] = values[side][..., :: 2 if case == "same_size" else 4]
    yield from compared(values, golden, tolerances)


class Evaluated(AspanTransformer):
    """As in a published evaluation: one scale for positions, the global level of a size (rows,
    columns).
    """

    def __init__(self, scale, coarsest):
        super().__init__(None)
        self.scale = scale
        self.coarsest = coarsest

    def side(self, coarse, mask):
        height, width = coarse.shape[2:]
        self.train_size = (
            self.scale * COARSE_STRIDE * height,
            self.scale * COARSE_STRIDE * width,
        )
        rows, columns = height // self.coarsest[0], width // self.coarsest[1]
        return replace(super().side(coarse, mask), factor=(rows, columns))


def evaluated(scale, coarsest, training=Training.OUTDOOR):
    network = AspanFormer(training)
    network.loftr_coarse = Evaluated(scale, coarsest)
    return network


@cache
def aspanformer_state():
    """Follow the recipe of the golden vectors' README; the folder has no ``standin.py``."""
    shapes = json.loads((GOLDEN / "aspanformer" / "shapes.json").read_text())["parameters"]
    state = {}
    for name, shape in shapes.items():
        value = seeded_tensor(
            name, shape, 4.0 if name.startswith("fine_preprocess.") else 1.0
        )
        if name.endswith(".affine"):
            value += 1.0
        elif name.endswith("attention.temp"):
            value += 1.5
        elif name == "coarse_matching.temperature":
            value = torch.tensor(10.0)
        state[name] = value
    return {name: value for name, value in state.items() if "sample_offset" not in name}


def thinned(name, value):
    """Return the part of a value that a file keeps: ``_cK`` each K-th channel, ``_rowsK`` each K-th
    row.
    """
    kind, step = re.fullmatch(r".*_(c|rows)(\d+)", name).groups()
    return value[..., :: int(step)] if kind == "c" else value[:, :: int(step)]


def aspanformer_stages(case, make):
    golden = golden_arrays("aspanformer", case)
    originals = [golden[f"image{side}"] for side in (0, 1)]
    images = []
    for (
        image
    ) in originals:  # as in the evaluation: sides rounded down, bilinear, not antialiased
        size = [side // SPEC.multiple * SPEC.multiple for side in image.shape[2:]]
        images.append(torch.nn.functional.interpolate(image, size=size, mode="bilinear"))
    masks, scales = masks_and_scales(golden)
    coarse_scales = None
    if masks is None:  # in online mode coarse points are reported before the last rescaling
        coarse_scales = scales
        scales = []
        for original, resized in zip(originals, images, strict=True):
            scale_x = original.shape[3] / resized.shape[3]
            scale_y = original.shape[2] / resized.shape[2]
            scales.append(torch.tensor([[scale_x, scale_y]]))
    network = ready(make(), aspanformer_state())
    # Stand-in weights have low confidences; at the published threshold no match would be left.
    network.threshold = 1e-3
    values = computed(network, images, masks, scales, coarse_scales)
    names = (("conf_rowmax", "conf_row_max"), ("conf_colmax", "conf_col_max"))
    for side, (old, new) in enumerate(names):
        values[new] = values.pop(old)
        # Where all is padding the reference has about 1 / (L S), and this network nothing
        if masks:
            golden[new] = golden[new] * masks[side].flatten(1)
    for name in golden:
        whole = re.sub(r"_final(?=\d)", "", re.sub(r"_(c|rows)\d+$", "", name))
        if whole in values and name not in values:
            values[name] = thinned(name, values[whole])
    yield from compared(values, golden, ASPANFORMER)


MEGADEPTH = 832 / 1152
ASPANFORMERS = {
    "outdoor_online": AspanFormer,
    "outdoor_online_resize": AspanFormer,
    "outdoor_padded_batch": lambda: evaluated(MEGADEPTH, (7, 7)),
    "indoor_direct": lambda: evaluated(1.0, (4, 3), Training.INDOOR),
}
FAMILY = (
    (Loftr, ("same_size", "diff_size", "masked_batch", "no_match"), LOFTR),
    (Quadtree, ("same_size", "diff_size_extension", "masked_batch"), QUADTREE),
)
CASES = {
    f"{network.__name__} {case}": partial(loftr_stages, network, case, tolerances)
    for network, cases, tolerances in FAMILY
    for case in cases
}
CASES |= {
    f"aspanformer {case}": partial(aspanformer_stages, case, make)
    for case, make in ASPANFORMERS.items()
}
