"""QuadTree against the golden vectors of its reference."""

from functools import cache

import pytest
import torch
from golden import Stage, assert_stages, golden_arrays, needs_golden, ready, standin_state
from semi_dense import loftr_stages

from mkpc_kaggle.matchers.networks.grids import mean_pool
from mkpc_kaggle.matchers.networks.quadtree import Quadtree, attend, quadtree_attention

CASES = ("same_size", "diff_size_extension", "masked_batch")
OPERATORS = ("attention_op", "attention_op_unequal")
TOLERANCES = {"coarse": 1e-4, "conf": 2e-4, "mconf": 2e-4, "expec_f": 5e-4, "mkpts1_f": 2e-3}
HEADS = 2  # of the operator's golden vectors


@cache
def standin():
    """With a backbone laid out as the reference's, whose maps then agree to the last bit here.

    Which key cells are kept is discontinuous: in the masked case the rounding of the channels-last layout, well
    within the tolerance of the maps, tips a near tie. LoFTR's vectors test that layout with the same weights.
    """
    network = ready(Quadtree(), standin_state("quadtree"))
    network.backbone.to(memory_format=torch.contiguous_format)
    return network


def by_head(grid):
    """(N, h, w, HEADS D) -> (N HEADS, h, w, D)."""
    return grid.unflatten(3, (HEADS, -1)).permute(0, 3, 1, 2, 4).flatten(0, 1)


@needs_golden
@pytest.mark.parametrize("case", CASES)
def test_stages(case):
    assert_stages(loftr_stages("quadtree", case, standin(), TOLERANCES))


@needs_golden
@pytest.mark.parametrize("case", OPERATORS)
def test_operator(case):
    golden = golden_arrays("quadtree", case)
    q, k, v = (by_head(golden[name].permute(0, 2, 3, 1)) for name in "qkv")
    topks = tuple(golden["topks"][:2].tolist())
    pooled = [mean_pool(x, 4).flatten(1, 2)[:, None] for x in (q, k, v)]
    kept = attend(*pooled, topks[0]).kept  # (2 HEADS, 1, cells, 6)
    kept = kept[:, 0].unflatten(0, (-1, HEADS)).permute(0, 2, 3, 1)
    # Which are kept counts, and not their order.
    kept, expected = (x.long().sort(dim=2).values for x in (kept, golden["top_idx_level0"]))
    message = quadtree_attention(q, k, v, golden["level_weight"].softmax(0), topks)
    message = message.flatten(1, 2).unflatten(0, (-1, HEADS)).transpose(1, 2)  # (2, h w, HEADS, D)
    assert_stages([Stage("top_idx_level0", kept, expected), Stage("message", message, golden["message"], 1e-5)])
