"""ASpanFormer against the golden vectors of its reference."""

import json
import re
from dataclasses import replace
from functools import cache

import pytest
import torch
from golden import GOLDEN, Stage, assert_stages, golden_arrays, needs_golden, ready, seeded_tensor
from semi_dense import traced

from mkpc_kaggle.matchers.networks.adaptive_span import CELLS_AT_ONCE, span_attention
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.fine_matching import cell_points
from mkpc_kaggle.matchers.networks.grids import to_2x2_blocks

MEGADEPTH = (832 / 1152, 832 / 1152)


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


CASES = {
    "outdoor_online": lambda: AspanFormer(1e-3),
    "outdoor_online_resize": lambda: AspanFormer(1e-3),
    "outdoor_padded_batch": lambda: Evaluated(MEGADEPTH, (7, 7)),
    "indoor_direct": lambda: Evaluated((1.0, 1.0), (4, 3), border=0),
}
CONFIDENCE = (2e-3, 1e-6)  # relative and absolute
POINTS = 1e-2  # pixels
FEATURES = 1e-4
EXPECTATION = 5e-4  # in half windows, of four pixels
EXACT = ("b_ids", "i_ids", "j_ids")


@cache
def standin():
    """The recipe of the golden vectors' README; the folder has no ``standin.py``."""
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
    """Sides rounded down to multiples of 32: bilinear, not antialiased, as in the published evaluation."""
    size = [side // AspanFormer.multiple * AspanFormer.multiple for side in image.shape[2:]]
    return torch.nn.functional.interpolate(image, size=size, mode="bilinear")


def stages_of(case):
    golden = golden_arrays("aspanformer", case)
    network = ready(CASES[case](), standin())
    images = [rounded_down(golden[f"image{side}"]) for side in (0, 1)]
    masks = (golden["mask0"], golden["mask1"]) if "mask0" in golden else None
    trace = traced(network, images, masks)
    matches, coarse, confidence = trace.matches, trace.matches.coarse, trace.confidence
    got = {"conf": confidence, "conf_row_max": confidence.amax(2), "conf_col_max": confidence.amax(1)}
    got |= {"b_ids": coarse.batch, "i_ids": coarse.cell0, "j_ids": coarse.cell1, "mconf": coarse.confidence}
    got |= {"expec_f": matches.expectation}
    for side in (0, 1):
        resized, original = images[side].shape, golden[f"image{side}"].shape
        scale = torch.tensor([[original[3] / resized[3], original[2] / resized[2]]])
        factor = golden[f"scale{side}"][coarse.batch] if masks else scale
        points = cell_points((coarse.cell0, coarse.cell1)[side], trace.grids[side].shape[2])
        got[f"coarse_final{side}"] = trace.grids[side].flatten(1, 2)
        # In online mode coarse points are reported before the last rescaling.
        got[f"mkpts{side}_c"] = points * factor if masks else points
        got[f"mkpts{side}_f"] = (matches.points0, matches.points1)[side] * factor

    for side, name in enumerate(("conf_row_max", "conf_col_max")):
        if masks:  # where all is padding the reference has about 1 / (L S), and this network nothing
            golden[name] = golden[name] * masks[side].flatten(1)
    return [stage_of(name, got[base_of(name)], golden[name]) for name in golden if base_of(name) in got]


def base_of(name):
    """Without what says how much was kept: ``_cK`` each K-th channel, ``_rowsK`` each K-th row."""
    return re.sub(r"_(c|rows)\d+$", "", name)


def stage_of(name, value, expected):
    base, thinned = base_of(name), re.search(r"_(c|rows)(\d+)$", name)
    if thinned:
        step = int(thinned[2])
        value = value[..., ::step] if thinned[1] == "c" else value[:, ::step]
    if base in EXACT:
        return Stage(name, value, expected)
    if base.startswith(("conf", "mconf")):
        allowed = CONFIDENCE[0] * expected.double().abs() + CONFIDENCE[1]
        return Stage(f"{name}, in tolerances", value / allowed, expected / allowed, 1.0)
    tolerance = EXPECTATION if base == "expec_f" else POINTS if base.startswith("mkpts") else FEATURES
    return Stage(name, value, expected, tolerance)


def as_map(grid):
    return grid.permute(0, 3, 1, 2)


@needs_golden
@pytest.mark.parametrize("case", CASES)
def test_stages(case):
    assert_stages(stages_of(case))


def test_span_attention_is_that_of_sampled_keys(monkeypatch):
    """Against grid_sample, with samples far outside and a batch, in several chunks."""
    monkeypatch.setitem(CELLS_AT_ONCE, "cpu", 5)
    generator = torch.Generator().manual_seed(0)
    q = torch.randn(2, 4, 6, 16, generator=generator)
    k, v = torch.randn(2, 2, 5, 7, 16, generator=generator)
    samples = torch.rand(2, 6, 64, 2, generator=generator) * 30 - 10
    samples[0, 0, 0] = 1e12
    usable = torch.rand(2, 6, 64, generator=generator) > 0.3
    usable[1, 2] = False
    relative = 2 * samples / torch.tensor([7.0, 5.0]) - 1
    read = [torch.nn.functional.grid_sample(as_map(x), relative, align_corners=False) for x in (k, v)]
    key, value = (x.permute(0, 2, 3, 1).unflatten(3, (2, 8)) for x in read)  # (N, cells, 64, heads, 8)
    query = to_2x2_blocks(q).unflatten(3, (2, 8))  # (N, cells, 4, heads, 8)
    for mask in (None, usable):
        logits = torch.einsum("npqhd,npshd->nphqs", query, key) / 8**0.5
        if mask is not None:
            logits = logits.masked_fill(~mask[:, :, None, None], -1e8)
        expected = torch.einsum("nphqs,npshd->npqhd", logits.softmax(-1), value).reshape(q.shape)
        torch.testing.assert_close(span_attention(q, k, v, samples, 2, mask), expected, rtol=1e-4, atol=1e-5)
