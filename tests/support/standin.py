"""Stand-in weights made by code alone. They are useless for photographs, but networks respond to
texture and match.

Every number is made of bytes of SHAKE-256 of a name, so that no generator of numpy's or torch's can
change it.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.networks import dinov2, roma
from mkpc_kaggle.matchers.networks.roma import RoMa
from mkpc_kaggle.matchers.networks.warp_refiner import WarpRefinerShape


@dataclass(frozen=True)
class StandIn:
    """How a network's stand-in weights depart from the rule of :func:`value_of`.

    ``gain``: factor of all maps, besides their fan-in. ``scales``: factors of the parameters whose names match.
    ``values``: set for those parameters, or for single entries, ``"convPb.bias[64]"``.
    """

    gain: float = 2.0
    scales: Mapping[str, float] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)


# Found by trial: with them a picture and its shifted copy have matches, and not everything matches.
SUPERGLUE = {
    "kenc.encoder.12.weight": 0.3,
    "kenc.encoder.12.bias": 0.1,
    "final_proj.weight": 5.0,
}
SUPERGLUE |= {
    "*.attn.proj.[01].weight": 16.0,
    "*.mlp.0.weight": 8.0,
    "*.mlp.3.weight": 0.1,
    "*.mlp.3.bias": 0.01,
}
LIGHTGLUE = {
    "input_proj.weight": 16.0,
    "transformers.*.ffn.3.*": 0.1,
    "*.final_proj.weight": 4.0,
}
ASPANFORMER = {"*.layer3_outconv.weight": 2.0, "*.flow_decoder.2.weight": 0.3}
ROMA = {
    "*.gamma": 10.0,
    "*.cls_token": 10.0,
    "*.pos_embed": 40.0,
    "*.conv_refiner.*.out_conv.weight": 10.0,
}
# Features of coarse strides are not of one place, so that shifted pictures would have little in
# common.
LOMA = {
    "*decoder.layers.[48].out_conv.*": 0.05,
    "matcher.posenc.Wr.weight": 3.0,
    "matcher.*.ffn.3.weight": 0.1,
}
LOMA |= {"matcher.*.Wqkv.weight": 1.4, "matcher.*.to_qk.weight": 1.4}
# Gains that keep the size of signals from layer to layer; without them deep maps die out.
STAND_INS = {
    "superpoint": StandIn(
        3.0, {"conv1a.weight": 2.0, "convPb.weight": 2.0}, {"convPb.bias[64]": 7.0}
    ),
    "superglue": StandIn(1.0, SUPERGLUE, {"bin_score": 45.0}),
    "loftr": StandIn(2.0, {"backbone.layer3_outconv.weight": 0.9}),
    "quadtree": StandIn(
        2.0, {"backbone.layer3_outconv.weight": 1.8, "*.attn.py_att.weight": 4.0}
    ),
    "aspanformer": StandIn(2.0, ASPANFORMER, {"coarse_matching.temperature": 6.0}),
    "aliked": StandIn(2.0, {"score_head.6.weight": 3.0, "desc_head.offset_conv.2.*": 3.0}),
    "xfeat": StandIn(2.0),
    "lightglue": StandIn(1.0, LIGHTGLUE),
    "roma": StandIn(1.5, ROMA),
    "dkm": StandIn(
        1.5, {"*.terminal_module.*.weight": 2.0, "*.conv_refiner.*.out_conv.weight": 2.0}
    ),
    "loma": StandIn(2.0, LOMA),
}


# RoMa with fewer channels, a thirtieth of its size: most of the remaining weights are VGG's.
REFINERS = {
    16: (64, 16, 7, 369),
    8: (48, 8, 3, 153),
    4: (32, 8, 2, 97),
    2: (16, 4, None, 36),
    1: (9, 6, None, 24),
}
REFINERS = {stride: WarpRefinerShape(*shape) for stride, shape in REFINERS.items()}


def narrow_roma() -> RoMa:
    vit = {"WIDTH": 64, "BLOCKS": 2, "HEADS": 2, "POSITIONS": 5}
    decoder = {"BLOCKS": 2, "HEADS": 2}
    with patch.multiple(dinov2, **vit), patch.multiple(roma, REFINERS=REFINERS, **decoder):
        return RoMa()


def uniform(name: str, shape: Sequence[int] = ()) -> np.ndarray:
    """float64 in (-1, 1), 2^16 different values, as the name has it."""
    count = int(np.prod(shape, dtype=int))
    whole = np.frombuffer(hashlib.shake_256(name.encode()).digest(2 * count), "<u2").astype(
        np.float64
    )
    return ((2 * whole + 1) / 2**16 - 1).reshape(shape)


def value_of(name: str, shape: Sequence[int], gain: float) -> np.ndarray:
    """The value of one parameter or buffer.

    Maps have no mean, so that a flat input leaves them silent, and the variance ``gain`` / fan-in.
    Norms are nearly neutral, with positive variances; biases are small.
    """
    numbers = uniform(name, shape)
    if len(shape) > 1:
        axes = tuple(range(1, len(shape)))
        fan_in = np.prod(shape[1:])
        mean = numbers.mean(axis=axes, keepdims=True) if fan_in > 1 else 0
        return (numbers - mean) * np.sqrt(3 * gain / fan_in)
    if name.endswith("running_var") or (shape and name.endswith(("weight", "affine"))):
        return 1 + 0.2 * numbers
    return 0.1 * numbers


def standin_state(network: nn.Module, standin: StandIn) -> dict[str, Tensor]:
    """A checkpoint of a network of ours: float32 tensors by name; integer buffers are 0."""
    state = {}
    for name, tensor in network.state_dict().items():
        if not tensor.is_floating_point():
            state[name] = torch.zeros_like(tensor)
            continue
        scale = np.prod(
            [
                factor
                for pattern, factor in standin.scales.items()
                if fnmatchcase(name, pattern)
            ]
        )
        value = scale * value_of(name, tuple(tensor.shape), standin.gain)
        state[name] = torch.from_numpy(np.asarray(value, np.float32))
    for name, value in standin.values.items():
        key, _, entry = name.removesuffix("]").partition("[")
        state[key].view(-1)[slice(None) if not entry else int(entry)] = value
    return state


def filled(network: nn.Module, name: str) -> nn.Module:
    network.load_state_dict(standin_state(network, STAND_INS[name]))
    return network


def scene(height: int, width: int, channels: int = 1, name: str = "scene") -> np.ndarray:
    """A picture with texture at all scales, (height, width, channels) uint8; exact, for it is made
    of integers.
    """
    total = np.zeros((height, width, channels), int)
    for cell in (3, 8, 24):
        rows = -(-height // cell)
        columns = -(-width // cell)
        steps = uniform(f"{name}, {cell}", (rows, columns, channels)) * 128
        total += np.kron(steps.astype(int), np.ones((cell, cell, 1), int))[:height, :width]
    return (128 + total // 3).astype(np.uint8)
