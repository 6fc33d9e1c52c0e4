"""QuadTree against the golden vectors of its reference."""

from copy import deepcopy
from functools import cache

import pytest
import torch
from golden import Stage, assert_stages, golden_arrays, needs_golden, ready, standin_state
from semi_dense import loftr_stages

from mkpc_kaggle.matchers.networks import quadtree
from mkpc_kaggle.matchers.networks.grids import mean_pool
from mkpc_kaggle.matchers.networks.quadtree import Attended, Quadtree, attend, quadtree_attention

CASES = ("same_size", "diff_size_extension", "masked_batch")
OPERATORS = ("attention_op", "attention_op_unequal")
TOLERANCES = {"coarse": 1e-4, "conf": 2e-4, "mconf": 2e-4, "expec_f": 5e-4, "mkpts1_f": 2e-3}
HEADS = 2  # of the operator's golden vectors
NEAR_TIE = 1e-4  # of logits up to 10: float32 rounds them by some 1e-5
MAX_NEAR_TIES = 5  # of 32,000 choices; 0 or 1 were seen on different processors


@cache
def standin():
    return ready(Quadtree(), standin_state("quadtree"))


@torch.inference_mode()
def golden_choices(images, monkeypatch):
    """Return the key cells that each call of ``attend`` keeps in float64, which is the reference's choice.

    The choice is discontinuous. In float32 the processor's rounding decides a near tie, in float64 it does not.
    """
    choices = []

    def recording(*given):
        found = attend(*given)
        choices.append(found.kept)
        return found

    network = deepcopy(standin()).double()
    with monkeypatch.context() as patched:
        patched.setattr(quadtree, "attend", recording)
        network.transform(*(network.encode(image.double()).coarse for image in images))
    return [kept for kept in choices if kept is not None]


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


def by_head(grid):
    """(N, h, w, HEADS D) -> (N HEADS, h, w, D)."""
    return grid.unflatten(3, (HEADS, -1)).permute(0, 3, 1, 2, 4).flatten(0, 1)


@needs_golden
@pytest.mark.parametrize("case", CASES)
def test_stages(case, monkeypatch):
    golden = golden_arrays("quadtree", case)
    choices = golden_choices([golden[f"image{side}_u8"][:, None] / 255 for side in (0, 1)], monkeypatch)
    near_ties = []
    monkeypatch.setattr(quadtree, "attend", choosing(choices, near_ties))
    assert_stages(loftr_stages("quadtree", case, standin(), TOLERANCES))
    assert len(near_ties) == len(choices)
    assert sum(near_ties) <= MAX_NEAR_TIES, f"{sum(near_ties)} choices differ by less than {NEAR_TIE:g}"


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
