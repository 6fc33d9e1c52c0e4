"""The known entries of every published checkpoint load into the networks.

Names and shapes alone, on the device "meta", with surplus entries of the files: wrappers,
counters, remains of the training. The lists of ``shapes.json`` were made from the original networks.
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import kornia.feature
import pytest
import torch
from golden import GOLDEN, needs_golden
from torch import Tensor, nn

from mkpc_kaggle.config import from_table
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.registry import load_matcher, spec_of

Shapes = Mapping[str, tuple[int, ...]]


class Published:
    """A store of one checkpoint per slot, with its names and shapes only."""

    def __init__(self, tables: Mapping[str, Shapes]) -> None:
        self.tables = tables

    def load(self, slot: str) -> dict[str, Tensor]:
        shapes = self.tables[slot]
        return {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}


def problem_of(matcher: str, tables: Mapping[str, Shapes]) -> str:
    """Return why these checkpoints do not fit, with options that ask for the last slot."""
    spec = spec_of(matcher, "test")
    # "loftr-outdoor" of "loftr-{training}" has the training "outdoor".
    slot = list(tables)[-1]
    table = {}
    for own in spec.slots:
        beginning, _, option = own.partition("{")
        if option and slot.startswith(beginning) and slot not in spec.slots:
            table[option[:-1]] = slot.removeprefix(beginning)
    options = from_table(spec.options, table, "test")
    try:
        # Names and shapes alone, without memory.
        with torch.device("meta"):
            load_matcher(matcher, Published(tables), options, Placement("meta"))
    except UserError as error:
        return str(error)
    return ""


def golden_shapes(*path: str) -> dict[str, tuple[int, ...]]:
    """Read the shapes of one network; ``path``: the folder, then keys of its table."""
    table: Any = json.loads((GOLDEN / path[0] / "shapes.json").read_text())
    for key in path[1:]:
        table = table[key]
    return {name: tuple(shape) for name, shape in table.items()}


def linear(name: str, outputs: int, inputs: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


@dataclass(frozen=True)
class Glue:
    """The shape of a published LightGlue."""

    inputs: int
    width: int = 256
    heads: int = 4
    layers: int = 9
    position: int = 2  # 4: x, y, scale and orientation

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the entries by their current names: 253 with nine layers and an input projection."""
        width = self.width
        table = linear("input_proj", width, self.inputs) if self.inputs != width else {}
        table |= {"posenc.Wr.weight": (width // self.heads // 2, self.position)}
        for n in range(self.layers):
            own = f"transformers.{n}.self_attn"
            cross = f"transformers.{n}.cross_attn"
            table |= linear(f"{own}.Wqkv", 3 * width, width)
            table |= linear(f"{own}.out_proj", width, width)
            for part in ("to_qk", "to_v", "to_out"):
                table |= linear(f"{cross}.{part}", width, width)
            for block in (own, cross):
                table |= linear(f"{block}.ffn.0", 2 * width, 2 * width)
                table |= linear(f"{block}.ffn.3", width, 2 * width)
                table |= {f"{block}.ffn.1.{name}": (2 * width,) for name in ("weight", "bias")}
            table |= linear(f"log_assignment.{n}.matchability", 1, width)
            table |= linear(f"log_assignment.{n}.final_proj", width, width)
        # The last layer stops anyway, so it has no confidence.
        for n in range(self.layers - 1):
            table |= linear(f"token_confidence.{n}.token.0", 1, width)
        return table


def with_old_names(shapes: Shapes) -> dict[str, tuple[int, ...]]:
    """Return the names of the first LightGlue: self_attn.N instead of transformers.N.self_attn."""

    current = re.compile(r"transformers\.(\d+)\.(\w+)\.")
    return {current.sub(r"\2.\1.", name): shape for name, shape in shapes.items()}


def with_prefix(prefix: str, shapes: Shapes) -> dict[str, tuple[int, ...]]:
    return {f"{prefix}{name}": shape for name, shape in shapes.items()}


def shapes_of(network: nn.Module) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}


def aliked() -> dict[str, tuple[int, ...]]:
    table = shapes_of(kornia.feature.ALIKED("aliked-n16"))
    del table["dkd.hw_grid"]  # computed
    return table


def xfeat() -> dict[str, tuple[int, ...]]:
    return shapes_of(kornia.feature.XFeat().net)


ALIKED = Glue(128)
SIFT = Glue(128, position=4)
XFEAT = Glue(64, width=96, heads=1, layers=6)
# Of disk_lightglue.pth: a learned number for each assignment.
NUMBERS = {f"log_assignment.{n}.r": (1,) for n in range(9)}


def lighterglue() -> dict[str, tuple[int, ...]]:
    """With the extractor of its training, which no matcher needs."""
    matcher = with_prefix("matcher.", with_old_names(XFEAT.shapes()))
    return matcher | with_prefix("extractor.model.net.", xfeat())


Tables = dict[str, Shapes]  # by slot
# The matcher, its checkpoints, entries of the last
SPARSE: dict[str, tuple[str, Callable[[], Tables], int]] = {
    "aliked-n16.pth": ("aliked", lambda: {"aliked-n16": aliked()}, 76),
    "aliked_lightglue.pth": (
        "aliked_lightglue",
        lambda: {"aliked-n16": aliked(), "aliked-lightglue": ALIKED.shapes()},
        253,
    ),
    "xfeat-lighterglue.pt": (
        "xfeat_lighterglue",
        lambda: {"xfeat": xfeat(), "xfeat-lighterglue": lighterglue()},
        169 + 122,
    ),
    "sift_lightglue.pth": ("sift_lightglue", lambda: {"sift-lightglue": SIFT.shapes()}, 253),
    "sift_lightglue.pth, old names": (
        "sift_lightglue",
        lambda: {"sift-lightglue": with_old_names(SIFT.shapes())},
        253,
    ),
    "sift_lightglue.pth with the numbers of disk_lightglue.pth": (
        "sift_lightglue",
        lambda: {"sift-lightglue": with_old_names(SIFT.shapes()) | NUMBERS},
        262,
    ),
}


@pytest.mark.parametrize("name", SPARSE)
def test_lightglue_and_its_detector_load_with_renamed_and_surplus_entries(name):
    matcher, make, count = SPARSE[name]
    tables = make()
    assert len(list(tables.values())[-1]) == count
    assert problem_of(matcher, tables) == ""


@pytest.mark.parametrize(
    "lost", ["log_assignment.8.matchability.bias", "transformers.3.self_attn.Wqkv.weight"]
)
def test_a_lightglue_without_an_entry_that_it_needs_is_refused_by_its_name(lost):
    table = {name: shape for name, shape in SIFT.shapes().items() if name != lost}
    assert lost in problem_of("sift_lightglue", {"sift-lightglue": table})


TABLE = {"matcher.pos_encoding.pe": (1, 256, 256, 256)}  # computed; a repackaged file may have it


def semi_dense(network: str, *path: str) -> Callable[[], Shapes]:
    """Return the maker of a training checkpoint's entries."""
    return lambda: with_prefix("matcher.", golden_shapes(network, *path)) | TABLE


def superglue(training: str) -> Callable[[], Tables]:
    return lambda: {
        "superpoint": golden_shapes("superpoint"),
        f"superglue-{training}": golden_shapes("superglue"),
    }


def loma(variant: str, table: str) -> Callable[[], Tables]:
    """With a tenth layer, as deeper training models have."""

    def make() -> Tables:
        shapes = golden_shapes("loma", table)
        deeper = {
            name.replace(".8.", ".9.", 1): shape
            for name, shape in shapes.items()
            if name.startswith(("transformers.8.", "log_assignment.8."))
        }
        return {f"loma-{variant}": shapes | deeper}

    return make


def roma(training: str) -> Callable[[], Tables]:
    return lambda: {
        "dinov2-vitl14": golden_shapes("roma", "dinov2"),
        f"roma-{training}": golden_shapes("roma", "roma"),
    }


GOLDEN_LISTS: dict[str, tuple[str, Callable[[], Tables], int]] = {
    "loma_B128.pth": ("loma", loma("b128", "B128"), 739),
    "loma_B.pt": ("loma", loma("b", "B"), 1136),
    "loma_R.pth": ("loma", loma("r", "B"), 1136),  # B's architecture
}
for _training in ("outdoor", "indoor"):
    GOLDEN_LISTS |= {
        f"superglue_{_training}.pth": ("superglue", superglue(_training), 339),
        f"roma_{_training}.pth": ("roma", roma(_training), 603),
        f"DKMv3_{_training}.pth": (
            "dkm",
            lambda t=_training: {f"dkm-{t}": golden_shapes("dkm")},
            813,
        ),
        f"LoFTR {_training}": (
            "loftr",
            lambda t=_training: {f"loftr-{t}": semi_dense("loftr")()},
            212,
        ),
        f"quadtree_{_training}.ckpt": (
            "quadtree",
            lambda t=_training: {f"quadtree-{t}": semi_dense("quadtree")()},
            260,
        ),
        f"aspanformer_{_training}.ckpt": (
            "aspanformer",
            lambda t=_training: {f"aspanformer-{t}": semi_dense("aspanformer", "parameters")()},
            218,
        ),
    }


@needs_golden
@pytest.mark.parametrize("name", GOLDEN_LISTS)
def test_every_published_set_of_tensor_names_loads(name):
    matcher, make, count = GOLDEN_LISTS[name]
    tables = make()
    assert len(list(tables.values())[-1]) >= count
    assert problem_of(matcher, tables) == ""


# Indoor weights and LoMa's other variants have the same kinds of entries.
ALIKE = ("loma_B.pt", "loma_R.pth")
ONE_EACH = [name for name in GOLDEN_LISTS if "indoor" not in name and name not in ALIKE]


@needs_golden
@pytest.mark.parametrize("name", ONE_EACH)
def test_counters_of_batch_norms_may_be_missing_and_nothing_else(name):
    matcher, make, _ = GOLDEN_LISTS[name]
    # PyTorch before 0.4.1 had no counters, and inference does not use them.
    tables = {}
    for slot, table in make().items():
        kept = {entry for entry in table if not entry.endswith("num_batches_tracked")}
        tables[slot] = {entry: shape for entry, shape in table.items() if entry in kept}
    assert problem_of(matcher, tables) == ""
    slot, table = list(tables.items())[-1]
    lost = next(entry for entry in table if entry.endswith("running_mean"))
    tables[slot] = {entry: shape for entry, shape in table.items() if entry != lost}
    assert f"the weights for {slot!r} do not fit the network" in problem_of(matcher, tables)
