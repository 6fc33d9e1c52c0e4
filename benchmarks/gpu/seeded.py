"""Weights made by code alone, in the layout of the published files: real matchers without a file.

They are useless for photographs. They show arithmetic and speed.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib import import_module
from typing import Any

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers import adapters
from mkpc_kaggle.matchers.networks.aliked import Aliked
from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.networks.dkm import DKM
from mkpc_kaggle.matchers.networks.lightglue import LightGlue
from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.networks.loma import Loma, Variant
from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.matchers.networks.roma import RoMa
from mkpc_kaggle.matchers.networks.superglue import SuperGlue
from mkpc_kaggle.matchers.networks.superpoint import SuperPoint
from mkpc_kaggle.weights import WeightStore
from tests.support.standin import STAND_INS, narrow_roma, standin_state

State = dict[str, Tensor]

# By the beginning of a slot's name. The rest of the name is the training, which changes no shape.
SMALL: dict[str, tuple[str, Callable[[], nn.Module]]] = {
    "superpoint": ("superpoint", SuperPoint),
    "superglue-": ("superglue", SuperGlue),
    "loftr-": ("loftr", Loftr),
    "quadtree-": ("quadtree", Quadtree),
    "aspanformer-": ("aspanformer", AspanFormer),
    "dkm-": ("dkm", DKM),
    "aliked-n16": ("aliked", lambda: Aliked(2048, 16)),
    "aliked-n32": ("aliked", lambda: Aliked(2048, 32)),
}


class SeededWeights(WeightStore):
    """A store that makes the weights of every slot.

    ``layers`` are those of LightGlue, 9 as published. With ``narrow``, RoMa is the tests' RoMa of a
    thirtieth of its size, whose weights let a shifted picture match.
    """

    def __init__(self, *, layers: int = 9, narrow: bool = False) -> None:
        super().__init__([])
        self.layers = layers
        self.narrow = narrow

    def load(self, slot: str) -> State:
        return dict(_state_of(slot, self.layers, self.narrow))


# Large networks take seconds to fill, and are loaded in two precisions.
@cache
def _state_of(slot: str, layers: int, narrow: bool) -> State:
    # The most specific name first: "superpoint-lightglue" is no SuperPoint.
    if slot.endswith(("-lightglue", "-lighterglue")):
        return _lightglue_state(slot, layers)
    if slot.startswith("loma-"):
        return _loma_state(Variant(slot.removeprefix("loma-")))
    if slot.startswith(("roma-", "dinov2-")):
        return _roma_state(narrow, is_backbone=slot.startswith("dinov2-"))
    if slot == "disk":
        return _kornia_state("DISK")
    if slot == "xfeat":
        return standin_state(_xfeat(), STAND_INS["xfeat"])
    for prefix, (name, make) in SMALL.items():
        if slot.startswith(prefix):
            return standin_state(make(), STAND_INS[name])
    raise ValueError(f"no seeded weights for the slot {slot!r}")


def _lightglue_state(slot: str, layers: int) -> State:
    adapter: Any = import_module(f"{adapters.__name__}.{slot.replace('-', '_')}")
    # LighterGlue was published with six layers.
    own = min(layers, 6) if slot.endswith("-lighterglue") else layers
    shape = replace(adapter.SHAPE, layers=own)
    # Without confidences: untrained ones would stop early by chance. So all layers run.
    return standin_state(LightGlue(shape, adapts=False), STAND_INS["lightglue"])


def _loma_state(variant: Variant) -> State:
    if variant is Variant.B128:
        state = standin_state(Loma(variant), STAND_INS["loma"])
    else:
        state = random_state(lambda: Loma(variant))
    # The published names: the matcher's are bare, all others begin with an underscore.
    published = {}
    for name, tensor in state.items():
        own = name.removeprefix("matcher.")
        published[own if own != name else f"_{name}"] = tensor
    return published


@cache
def _whole_roma(narrow: bool) -> State:
    if narrow:
        return standin_state(narrow_roma(), STAND_INS["roma"])
    return random_state(RoMa)


def _roma_state(narrow: bool, *, is_backbone: bool) -> State:
    """Return the part of RoMa that one of its two files has."""
    part = {}
    for name, tensor in _whole_roma(narrow).items():
        own = name.removeprefix("dinov2.")
        if (own != name) == is_backbone:
            part[own] = tensor
    return part


def _xfeat() -> nn.Module:
    from mkpc_kaggle.matchers.adapters.xfeat_lighterglue import xfeat_network

    network: nn.Module = xfeat_network(2048).net
    return network


def _kornia_state(name: str) -> State:
    import kornia.feature

    # kornia's own initial values keep the scale of activations.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network: nn.Module = getattr(kornia.feature, name)()
    return network.state_dict()


def random_state(make: Callable[[], nn.Module]) -> State:
    """Return random weights that keep activations of order 1; stand-ins of this size take minutes."""
    with torch.device("meta"):
        network = make()
    generator = torch.Generator().manual_seed(0)
    state = {}
    for name, shape in network.state_dict().items():
        tensor = torch.zeros(shape.shape, dtype=shape.dtype)
        # A sum of n products of order 1 grows with the square root of n.
        if tensor.ndim > 1:
            tensor.normal_(std=tensor[0].numel() ** -0.5, generator=generator)
        elif name.endswith(("weight", "running_var", "gamma")):
            tensor.fill_(1)
        state[name] = tensor
    return state
