"""ASpanFormer against the golden vectors of its reference; run as a script it prints the table of differences."""

import json
import re
from dataclasses import replace
from functools import cache

import pytest
import torch
from golden import GOLDEN, Stage, assert_stages, golden_arrays, needs_golden, print_table, ready, seeded_tensor
from semi_dense import (
    traced,
)

from mkpc_kaggle.matchers.networks.adaptive_span import CELLS_AT_ONCE, adaptive_span, sample_usable, span_attention
from mkpc_kaggle.matchers.networks.aspanformer import RADIUS, AspanFormer
from mkpc_kaggle.matchers.networks.fine_matching import cell_points
from mkpc_kaggle.matchers.networks.grids import to_2x2_blocks
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY, sine_positions

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
EXPECTATION = 5e-4  # half a window, which is four pixels, is one
EXACT = ("b_ids", "i_ids", "j_ids", "b0_q0_samplemask", "b0_q1_samplemask", "kpt_scale", "pos_scale")
INITIAL = [f"loftr_coarse.ini_layer.layers_coarse.{index}" for index in range(2)]
BLOCKS = [f"loftr_coarse.layers.{index}" for index in range(4)]
ATTENTION = "loftr_coarse.layers.0.attention"
RECORDED = [*INITIAL, *BLOCKS, ATTENTION, "loftr_coarse.ini_layer"]
ORDER = ["resized", "kpt_scale", "pos_scale", "backbone_", "pe", "pos", "ini_layer", "ini_feat", "ini_flow"]
ORDER += [f"b{block}_{part}" for block in range(4) for part in ("flow\\d", "q", "feat", "flowfeat")]
ORDER += ["coarse_final", "conf_", "[bij]_ids", "mconf", "fine_in", "fine_out", "expec_f", "mkpts"]


@cache
def standin():
    """The recipe of the golden vectors' README; there is no ``standin.py``."""
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
    trace = traced(network, images, masks, RECORDED)
    matches, coarse, confidence = trace.matches, trace.matches.coarse, trace.confidence
    got = {"conf": confidence, "conf_row_max": confidence.amax(2), "conf_col_max": confidence.amax(1)}
    got |= {"b_ids": coarse.batch, "i_ids": coarse.cell0, "j_ids": coarse.cell1, "mconf": coarse.confidence}
    got |= {"expec_f": matches.expectation}
    for side in (0, 1):
        got |= inputs_of(side, images[side], trace.maps[side], network, golden)
        got |= transformer_of(side, network.loftr_coarse, trace)
        got |= levels_of(side, network.loftr_coarse.layers[0].attention, trace.calls)
        factor = golden[f"scale{side}"][coarse.batch] if masks else got[f"kpt_scale{side}"]
        points = cell_points((coarse.cell0, coarse.cell1)[side], trace.grids[side].shape[2])
        # In online mode coarse points are reported before the last rescaling.
        got[f"mkpts{side}_c"] = points * factor if masks else points
        got[f"mkpts{side}_f"] = (matches.points0, matches.points1)[side] * factor

    for side, name in enumerate(("conf_row_max", "conf_col_max")):
        if masks:  # where all is padding the reference has about 1 / (L S), and this network nothing
            golden[name] = golden[name] * masks[side].flatten(1)

    names = [name for name in golden if not re.fullmatch(r"(image|mask|scale)\d|pe_channels", name)]
    names.sort(key=lambda name: next(place for place, start in enumerate(ORDER) if re.match(start, name)))
    return [stage_of(name, got, golden[name]) for name in names]


def inputs_of(side, image, maps, network, golden):
    """What depends on one image alone."""
    original, (height, width) = golden[f"image{side}"].shape, image.shape[2:]
    scale = network.position_scale(height // 8, width // 8)
    got = {f"resized{side}": image, f"pos_scale{side}": torch.tensor(scale)}
    got |= {f"kpt_scale{side}": torch.tensor([[original[3] / width, original[2] / height]])}
    got |= {f"backbone_coarse{side}": maps.coarse, f"backbone_fine{side}": maps.fine}
    if "pe_channels" in golden:
        encoding = sine_positions(height // 8, width // 8, FIXED_DECAY, scale)[None, :, :, golden["pe_channels"]]
        thinned = 3 if "mask0" in golden else 1
        got[f"pe{side}_sel"] = as_map(encoding[:, ::thinned, ::thinned])
        prescaled = sine_positions(8, 8, FIXED_DECAY, MEGADEPTH)[None, :, :, golden["pe_channels"]]
        got["pe_prescaled_sel_8x8"] = as_map(prescaled)
    return got


def transformer_of(side, transformer, trace):
    """Features and flows after each layer, and the fine windows."""
    calls = trace.calls
    positions = calls["loftr_coarse"][0][0][side].positions
    got = {f"pos{side}": as_map(positions), f"coarse_final{side}": as_map(trace.grids[side]).flatten(2)}
    for index, name in enumerate(INITIAL):
        got[f"ini_layer{index}_sub{side}"] = as_map(calls[name][side][1])
    initial = calls["loftr_coarse.ini_layer"][0][1][side]
    got |= {f"ini_feat{side}": as_map(initial.visual), f"ini_flowfeat{side}": as_map(initial.flow)}
    for index, name in enumerate(BLOCKS):
        (own, other), updated = calls[name][side]
        got[f"b{index}_flow{side}"] = transformer.layers[index].decode_flow(own, other)
        got[f"b{index}_feat{side}"] = as_map(updated.visual)
        got[f"b{index}_flowfeat{side}"] = as_map(updated.flow)
    got[f"fine_in{side}_m6"], got[f"fine_out{side}_m6"] = trace.windows(side)
    return got


def levels_of(side, attention, calls):
    """Inside the attention of the first block: messages, spans and samples of its levels."""
    inputs, merged = calls[ATTENTION][side]
    coarse, half, full = attention.messages(*inputs)
    messages = {"global": coarse, "half": half, "full": full, "merged": merged}
    got = {f"b0_q{side}_msg_{level}": as_map(message) for level, message in messages.items()}
    q, k, _, flow, own, _ = inputs
    for level, factor in (("half", 2), ("full", 1)):
        span = adaptive_span(flow, RADIUS, factor)
        cells = (q.shape[1] // (2 * factor), q.shape[2] // (2 * factor))
        got[f"b0_q{side}_centre_{level}"] = span.centre.unflatten(1, cells)
        got[f"b0_q{side}_span_{level}"] = span.step.unflatten(1, cells)
        got[f"b0_q{side}_samples_{level}_first16cells"] = span.samples()[:, :16]
        if own.mask is not None:
            keys = (k.shape[1] // factor, k.shape[2] // factor)
            usable = sample_usable(span.samples(), own.mask, keys, factor)
            got[f"b0_q{side}_samplemask_{level}"] = usable[:, None]
    return got


def stage_of(name, got, expected):
    """The entry beside what its name says was kept of it: ``_cK`` channels, ``_rowsK`` rows, ``_s2`` pixels."""
    base, channels, rows, pixels = re.fullmatch(r"(.+?)(?:_c(\d+)|_rows(\d+))?(_s2)?", name).groups()
    value = got[base][:, :: int(channels or rows or 1)] if channels or rows else got[base]
    value = value[..., ::2, ::2] if pixels else value
    if base.startswith("ini_layer") and not channels:
        value = value[:, ::4]
    if base.startswith("coarse_final"):
        value = value.transpose(1, 2)
    if base in EXACT or name.startswith(EXACT):
        return Stage(name, value.float(), expected.float())
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


if __name__ == "__main__":
    print_table("aspanformer", [(case, stages_of(case)) for case in CASES])
