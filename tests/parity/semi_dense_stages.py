"""LoFTR, QuadTree and ASpanFormer against golden files: grids, confidences and matches."""

import json
import re
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from functools import cache, partial

import pytest
import torch
from golden import GOLDEN, Stage, Within, compared, golden_arrays, ready, recorded, seeded_tensor, standin_state

from mkpc_kaggle.matchers.networks import quadtree
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.coarse_matching import Cells, half_log_confidences
from mkpc_kaggle.matchers.networks.fine_matching import cell_points
from mkpc_kaggle.matchers.networks.grids import mean_pool
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY, ORIGINAL_DECAY, sine_positions
from mkpc_kaggle.matchers.networks.quadtree import Attended, Quadtree, attend, quadtree_attention

LOFTR = {"coarse": 1e-4, "conf": 1e-4, "mconf": 1e-4, "expec_f": 1e-4, "mkpts1_f": 5e-4}
QUADTREE = {"coarse": 1e-4, "conf": 2e-4, "mconf": 2e-4, "expec_f": 5e-4, "mkpts1_f": 2e-3}
# Expectation: in half windows, of four pixels.
ASPANFORMER = {"coarse": 1e-4, "m?conf": Within(1e-6, relative=2e-3), "expec_f": 5e-4, "mkpts": 1e-2}
# exp rounds the seventh frequency, near a tie, one way on AMD, the other on Intel; 256 times it is 7.6e-6.
POSITION = {"chan_first24": 1e-6, "col": 1e-5, "corner": 1e-5}
HEADS = 2  # of the golden vectors of QuadTree's operator
NEAR_TIE = 1e-4  # of logits up to 10: float32 rounds them by some 1e-5
MAX_NEAR_TIES = 5  # of 32,000 choices; 0 or 1 were seen on different processors


def confidence_of(network, grid0, grid1, masks):
    """Return the full confidence matrix (N, L, S)."""
    masks = masks or [torch.ones(grid.shape[:3], dtype=torch.bool) for grid in (grid0, grid1)]
    pairs = zip(grid0 * network.similarity_scale, grid1, *masks, strict=True)
    all_cells = [
        Cells(first.flatten(0, 1), second.flatten(0, 1), mask0.flatten(), mask1.flatten())
        for first, second, mask0, mask1 in pairs
    ]
    return torch.stack([torch.cat(list(half_log_confidences(cells))) for cells in all_cells]).mul(2).exp()


def computed(network, images, masks, scales, coarse_scales=None):
    """Return what all stages compute of images (N, 1, H, W), by name.

    Points are multiplied by ``scales`` (N, 2) of either side, coarse ones by ``coarse_scales`` if given.
    """
    maps = [network.encode(image) for image in images]
    with recorded(network, ["loftr_coarse"]) as calls:
        matches = network.match(*maps, masks)
    transformed = zip(calls["loftr_coarse"][0][1], maps, strict=True)
    grids = [tokens.reshape(len(tokens), *own.coarse.shape[2:], 256) for tokens, own in transformed]
    coarse, confidence = matches.coarse, confidence_of(network, *grids, masks)
    values = {"conf": confidence, "conf_rowmax": confidence.amax(2), "conf_colmax": confidence.amax(1)}
    values |= {"b_ids": coarse.batch, "i_ids": coarse.cell0, "j_ids": coarse.cell1, "mconf": coarse.confidence}
    values |= {"expec_f": matches.expectation}
    for side, grid in enumerate(grids):
        points = cell_points((coarse.cell0, coarse.cell1)[side], grid.shape[2])
        values[f"coarse{side}"] = grid.flatten(1, 2)
        values[f"mkpts{side}_c"] = points * (coarse_scales or scales)[side][coarse.batch]
        values[f"mkpts{side}_f"] = (matches.points0, matches.points1)[side] * scales[side][coarse.batch]
    return values


def masks_and_scales(golden):
    if "mask0" not in golden:
        return None, [torch.ones(1, 2)] * 2
    return (golden["mask0"], golden["mask1"]), (golden["scale0"], golden["scale1"])


@cache
def standin(name):
    return ready({"loftr": Loftr, "quadtree": Quadtree}[name](), standin_state(name))


def loftr_stages(name, case, tolerances):
    golden = golden_arrays(name, case)
    images = [golden[f"image{side}_u8"].float()[:, None] / 255 for side in (0, 1)]
    values = computed(standin(name), images, *masks_and_scales(golden))
    values["conf_rows"] = values["conf"][:, ::7]
    for side in ("coarse0", "coarse1"):
        values[side] = values[side][..., :: 2 if case == "same_size" else 4]
    yield from compared(values, golden, tolerances)


def position_stages():
    golden = golden_arrays("loftr", "pos_encoding")
    for prefix, decay in (("buggy", ORIGINAL_DECAY), ("fixed", FIXED_DECAY)):
        table = sine_positions(256, 256, decay).permute(2, 0, 1)
        got = {"chan_first24": table[:24, :12, :16], "col": table[:, 7, 200], "corner": table[:, 255, 255]}
        for name, values in got.items():
            yield Stage(f"{prefix}_{name}", values, golden[f"{prefix}_{name}"], POSITION[name])


def golden_choices(images):
    """Return the key cells that each call of ``attend`` keeps in float64, which is the reference's choice.

    The choice is discontinuous. In float32 the processor's rounding decides a near tie, in float64 it does not.
    """
    choices = []

    def recording(*given):
        found = attend(*given)
        choices.append(found.kept)
        return found

    network = deepcopy(standin("quadtree")).double()
    with patched_attend(recording):
        network.transform(*(network.encode(image.double()).coarse for image in images))
    return [kept for kept in choices if kept is not None]


@contextmanager
def patched_attend(function):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quadtree, "attend", function)
        yield


def choosing(choices, near_ties):
    """Return an ``attend`` that keeps these cells, and counts in ``near_ties`` where it would keep others.

    It fails where the logits of the cells differ by more than rounding.
    """
    remaining = iter(choices)

    def chosen(q, k, v, keep):
        found = attend(q, k, v, keep)
        if keep is None:
            return found
        golden, logits = next(remaining), (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)
        loss = logits.gather(-1, found.kept).amin(-1) - logits.gather(-1, golden).amin(-1)
        assert loss.max() < NEAR_TIE
        near_ties.append(int((loss > 0).sum()))
        return Attended(found.message, golden)

    return chosen


def quadtree_stages(case):
    golden, near_ties = golden_arrays("quadtree", case), []
    choices = golden_choices([golden[f"image{side}_u8"][:, None] / 255 for side in (0, 1)])
    with patched_attend(choosing(choices, near_ties)):
        yield from loftr_stages("quadtree", case, QUADTREE)
    assert len(near_ties) == len(choices)
    assert sum(near_ties) <= MAX_NEAR_TIES, f"{sum(near_ties)} choices differ by less than {NEAR_TIE:g}"


def by_head(grid):
    """(N, h, w, HEADS D) -> (N HEADS, h, w, D)."""
    return grid.unflatten(3, (HEADS, -1)).permute(0, 3, 1, 2, 4).flatten(0, 1)


def operator_stages(case):
    golden = golden_arrays("quadtree", case)
    q, k, v = (by_head(golden[name].permute(0, 2, 3, 1)) for name in "qkv")
    topks = tuple(golden["topks"][:2].tolist())
    pooled = [mean_pool(x, 4).flatten(1, 2)[:, None] for x in (q, k, v)]
    kept = attend(*pooled, topks[0]).kept  # (2 HEADS, 1, cells, 6)
    kept = kept[:, 0].unflatten(0, (-1, HEADS)).permute(0, 2, 3, 1)
    # The set of kept cells counts, not their order.
    kept, expected = (x.long().sort(dim=2).values for x in (kept, golden["top_idx_level0"]))
    message = quadtree_attention(q, k, v, golden["level_weight"].softmax(0), topks)
    message = message.flatten(1, 2).unflatten(0, (-1, HEADS)).transpose(1, 2)  # (2, h w, HEADS, D)
    yield Stage("top_idx_level0", kept, expected)
    yield Stage("message", message, golden["message"], 1e-5)


class Evaluated(AspanFormer):
    """As in a published evaluation: one scale (y, x) for positions, the global level of a size (rows, columns)."""

    def __init__(self, scale, coarsest, border=2):
        super().__init__(1e-3, border)
        self.scale, self.coarsest = scale, coarsest

    def side(self, coarse, mask):
        rows, columns = (side // of for side, of in zip(coarse.shape[2:], self.coarsest, strict=True))
        return replace(super().side(coarse, mask), factor=(rows, columns))

    def position_scale(self, height, width):
        return self.scale


@cache
def aspanformer_state():
    """Follow the recipe of the golden vectors' README; the folder has no ``standin.py``."""
    shapes = json.loads((GOLDEN / "aspanformer" / "shapes.json").read_text())["parameters"]
    state = {}
    for name, shape in shapes.items():
        value = seeded_tensor(name, shape, 4.0 if name.startswith("fine_preprocess.") else 1.0)
        if name.endswith(".affine"):
            value += 1.0
        elif name.endswith("attention.temp"):
            value += 1.5
        elif name == "coarse_matching.temperature":
            value = torch.tensor(10.0)
        state[name] = value
    return {name: value for name, value in state.items() if "sample_offset" not in name}


def rounded_down(image):
    """Resize to sides rounded down to multiples of 32: bilinear, not antialiased, as in the evaluation."""
    size = [side // AspanFormer.multiple * AspanFormer.multiple for side in image.shape[2:]]
    return torch.nn.functional.interpolate(image, size=size, mode="bilinear")


def thinned(name, value):
    """Return the part of a value that a file keeps: ``_cK`` each K-th channel, ``_rowsK`` each K-th row."""
    kind, step = re.fullmatch(r".*_(c|rows)(\d+)", name).groups()
    return value[..., :: int(step)] if kind == "c" else value[:, :: int(step)]


def aspanformer_stages(case, make):
    golden = golden_arrays("aspanformer", case)
    originals = [golden[f"image{side}"] for side in (0, 1)]
    images = [rounded_down(image) for image in originals]
    masks, scales = masks_and_scales(golden)
    coarse_scales = None
    if masks is None:  # in online mode coarse points are reported before the last rescaling
        shapes = [(o.shape, r.shape) for o, r in zip(originals, images, strict=True)]
        coarse_scales, scales = scales, [torch.tensor([[o[3] / r[3], o[2] / r[2]]]) for o, r in shapes]
    values = computed(ready(make(), aspanformer_state()), images, masks, scales, coarse_scales)
    for side, (old, new) in enumerate((("conf_rowmax", "conf_row_max"), ("conf_colmax", "conf_col_max"))):
        values[new] = values.pop(old)
        if masks:  # where all is padding the reference has about 1 / (L S), and this network nothing
            golden[new] = golden[new] * masks[side].flatten(1)
    for name in golden:
        whole = re.sub(r"_final(?=\d)", "", re.sub(r"_(c|rows)\d+$", "", name))
        if whole in values and name not in values:
            values[name] = thinned(name, values[whole])
    yield from compared(values, golden, ASPANFORMER)


MEGADEPTH = (832 / 1152, 832 / 1152)
ASPANFORMERS = {
    "outdoor_online": lambda: AspanFormer(1e-3),
    "outdoor_online_resize": lambda: AspanFormer(1e-3),
    "outdoor_padded_batch": lambda: Evaluated(MEGADEPTH, (7, 7)),
    "indoor_direct": lambda: Evaluated((1.0, 1.0), (4, 3), border=0),
}
CASES = {
    f"loftr {case}": partial(loftr_stages, "loftr", case, LOFTR)
    for case in ("same_size", "diff_size", "masked_batch", "no_match")
}
CASES["loftr positions"] = position_stages
CASES |= {
    f"quadtree {case}": partial(quadtree_stages, case)
    for case in ("same_size", "diff_size_extension", "masked_batch")
}
CASES |= {f"quadtree {case}": partial(operator_stages, case) for case in ("attention_op", "attention_op_unequal")}
CASES |= {f"aspanformer {case}": partial(aspanformer_stages, case, make) for case, make in ASPANFORMERS.items()}
