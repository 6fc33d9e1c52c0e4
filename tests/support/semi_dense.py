"""What the parity tests of LoFTR, QuadTree and ASpanFormer share."""

from dataclasses import dataclass

import torch
from golden import Stage, golden_arrays, recorded
from torch import Tensor

from mkpc_kaggle.matchers.networks.coarse_matching import Cells, half_log_confidences
from mkpc_kaggle.matchers.networks.fine_matching import SemiDenseMatches, cell_points


def confidence_of(network, grid0, grid1, masks=None):
    """The full confidence matrix (N, L, S)."""
    masks = masks or [torch.ones(grid.shape[:3], dtype=torch.bool) for grid in (grid0, grid1)]
    pairs = zip(grid0 * network.similarity_scale, grid1, *masks, strict=True)
    all_cells = [
        Cells(first.flatten(0, 1), second.flatten(0, 1), mask0.flatten(), mask1.flatten())
        for first, second, mask0, mask1 in pairs
    ]
    return torch.stack([torch.cat(list(half_log_confidences(cells))) for cells in all_cells]).mul(2).exp()


def tolerance_of(name, tolerances):
    """That of the entry's prefix; 0 where it has none: then it must agree exactly."""
    return next((tolerance for prefix, tolerance in tolerances.items() if name.startswith(prefix)), 0.0)


@dataclass(frozen=True, eq=False)
class Trace:
    """What a network computed on the way to its matches.

    The transformer's ``grids`` (N, h, w, 256) of both images, and the full ``confidence`` (N, L, S).
    """

    grids: list[Tensor]
    confidence: Tensor
    matches: SemiDenseMatches


@torch.inference_mode()
def traced(network, images, masks):
    """Images (N, 1, H, W) matched."""
    maps = [network.encode(image) for image in images]
    with recorded(network, ["loftr_coarse"]) as calls:
        matches = network.match(*maps, masks)
    transformed = zip(calls["loftr_coarse"][0][1], maps, strict=True)
    grids = [tokens.reshape(len(tokens), *own.coarse.shape[2:], 256) for tokens, own in transformed]
    return Trace(grids, confidence_of(network, *grids, masks), matches)


def loftr_stages(folder, case, network, tolerances):
    """Features after the transformer, confidences and matches of a golden file of LoFTR's kind."""
    golden = golden_arrays(folder, case)
    images = [golden[f"image{side}_u8"].float()[:, None] / 255 for side in (0, 1)]
    masks = (golden["mask0"], golden["mask1"]) if "mask0" in golden else None
    trace = traced(network, images, masks)
    matches, coarse, confidence = trace.matches, trace.matches.coarse, trace.confidence
    got = {}
    for side, grid in enumerate(trace.grids):
        got[f"coarse{side}"] = grid.flatten(1, 2)[..., :: 2 if case == "same_size" else 4]
        scale = golden[f"scale{side}"][coarse.batch] if f"scale{side}" in golden else 1.0
        got[f"mkpts{side}_c"] = cell_points((coarse.cell0, coarse.cell1)[side], grid.shape[2]) * scale
        got[f"mkpts{side}_f"] = (matches.points0, matches.points1)[side] * scale
    got |= {"conf": confidence, "conf_rows": confidence[:, ::7]}
    got |= {"conf_rowmax": confidence.amax(2), "conf_colmax": confidence.amax(1)}
    got |= {"b_ids": coarse.batch, "i_ids": coarse.cell0, "j_ids": coarse.cell1, "mconf": coarse.confidence}
    got |= {"expec_f": matches.expectation}
    names = [name for name in got if name in golden]
    assert len(names) >= 4
    return [Stage(name, got[name], golden[name], tolerance_of(name, tolerances)) for name in names]


def random_network(make, gain=3.0):
    """The network with seeded random weights, whose features differ enough to be matched."""
    torch.manual_seed(0)
    network = make()
    with torch.no_grad():
        network.backbone.layer3_outconv.weight.mul_(gain)
    return network


def textured(*shape, seed=1):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def check_empty(matches):
    coarse = matches.coarse
    for cells in (coarse.batch, coarse.cell0, coarse.cell1):
        assert cells.shape == (0,) and cells.dtype == torch.int64
    assert coarse.confidence.shape == (0,)
    assert matches.points0.shape == matches.points1.shape == (0, 2)
    assert matches.expectation.shape == (0, 3)
