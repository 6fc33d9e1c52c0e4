"""The known entries of every published checkpoint load into the networks.

Names and shapes alone, on the device "meta", with surplus entries of the files: wrappers,
counters, remains of the training. The lists of ``shapes.json`` were made from the original networks.
"""

import json
from collections.abc import Mapping
from typing import Any

import pytest
import torch
from golden import GOLDEN, needs_golden
from torch import Tensor

from mkpc_kaggle.config import from_table
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.registry import load_matcher, spec_of

pytestmark = needs_golden

Shapes = dict[str, tuple[int, ...]]
Tables = dict[str, Shapes]  # by slot

# By slot: the option that asks for it, the matcher's table below GOLDEN, its number of entries
LISTS = {
    "loma-b128": ({"variant": "b128"}, "loma/B128", 739),
    "loma-b": ({"variant": "b"}, "loma/B", 1136),  # R has B's architecture
    "superglue-indoor": (
        {"training": "indoor"},
        "superglue",
        339,
    ),  # indoor files have these names
    "roma-outdoor": ({}, "roma/roma", 603),
    "dkm-outdoor": ({}, "dkm", 813),
    "loftr-outdoor": ({}, "loftr", 211),
    "quadtree-outdoor": ({}, "quadtree", 259),
    "aspanformer-outdoor": ({}, "aspanformer/parameters", 217),
}
# Of the same matchers
OTHERS = {"superglue": {"superpoint": "superpoint"}, "roma": {"dinov2-vitl14": "roma/dinov2"}}
# Computed; a repackaged file may have it
TABLE = {"matcher.pos_encoding.pe": (1, 256, 256, 256)}


class Published:
    """A store of one checkpoint per slot, with its names and shapes only."""

    def __init__(self, tables: Mapping[str, Shapes]) -> None:
        self.tables = tables

    def load(self, slot: str) -> dict[str, Tensor]:
        shapes = self.tables[slot]
        return {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}


def golden_shapes(path: str) -> Shapes:
    folder, _, key = path.partition("/")
    table: Any = json.loads((GOLDEN / folder / "shapes.json").read_text())
    return {name: tuple(shape) for name, shape in (table[key] if key else table).items()}


def tables_of(slot: str) -> Tables:
    """Return the checkpoints of a slot's matcher, that of the slot last."""
    matcher = slot.partition("-")[0]
    tables = {other: golden_shapes(path) for other, path in OTHERS.get(matcher, {}).items()}
    table = golden_shapes(LISTS[slot][1])
    if matcher in ("loftr", "quadtree", "aspanformer"):  # checkpoints of a training
        table = {f"matcher.{name}": shape for name, shape in table.items()} | TABLE
    elif matcher == "loma":  # deeper training models have a tenth layer
        last = ("transformers.8.", "log_assignment.8.")
        deeper = [name for name in table if name.startswith(last)]
        table |= {name.replace(".8.", ".9.", 1): table[name] for name in deeper}
    return {**tables, slot: table}


def problem_of(slot: str, tables: Tables) -> str:
    """Return why these checkpoints do not fit, with options that ask for the slot."""
    matcher = slot.partition("-")[0]
    options = from_table(spec_of(matcher, "test").options, LISTS[slot][0], "test")
    try:
        # Names and shapes alone, without memory.
        with torch.device("meta"):
            load_matcher(matcher, Published(tables), options, Placement("meta"))
    except UserError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("slot", LISTS)
def test_every_published_set_of_tensor_names_loads(slot):
    tables = tables_of(slot)
    assert len(tables[slot]) >= LISTS[slot][2]
    assert problem_of(slot, tables) == ""


@pytest.mark.parametrize("slot", ["superglue-indoor", "loftr-outdoor"])
def test_counters_of_batch_norms_may_be_missing_and_nothing_else(slot):
    # PyTorch before 0.4.1 had no counters, and inference does not use them.
    tables = {}
    for other, table in tables_of(slot).items():
        kept = {entry for entry in table if not entry.endswith("num_batches_tracked")}
        tables[other] = {entry: shape for entry, shape in table.items() if entry in kept}
    assert problem_of(slot, tables) == ""
    lost = next(entry for entry in tables[slot] if entry.endswith("running_mean"))
    del tables[slot][lost]
    assert f"the weights for {slot!r} do not fit the network" in problem_of(slot, tables)
