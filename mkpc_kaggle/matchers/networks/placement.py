"""Prepares a loaded network for inference: batch norms folded, on its device, in its precision."""

from itertools import pairwise
from typing import TypeVar

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from mkpc_kaggle.matchers.contract import Placement, Precision
from mkpc_kaggle.matchers.networks.layers import Exact

Network = TypeVar("Network", bound=nn.Module)

Norm = nn.BatchNorm1d | nn.BatchNorm2d
Layer = nn.Linear | nn.Conv1d | nn.Conv2d


def prepared(network: Network, placement: Placement) -> Network:
    """The network, changed in place; checkpoints cannot be loaded afterwards.

    The weights of convolutions and linear layers, :class:`Exact` ones apart, get the placement's precision, and
    with them the maps between convolutions. All else stays float32: what transformers add up, softmax, transport,
    coordinates.
    """
    fold_norms(network)
    for layer in network.modules():
        if isinstance(layer, Layer) and not isinstance(layer, Exact):
            for parameter in layer.parameters(recurse=False):
                parameter.data = parameter.to(dtype_of(placement))
    return network.to(placement.device)


def fold_norms(network: nn.Module) -> None:
    """Every batch norm goes into the convolution before it; computed in float64, rounded once."""
    for parent in list(network.modules()):
        for (conv_name, conv), (norm_name, norm) in pairwise(list(parent.named_children())):
            if isinstance(norm, Norm):
                assert isinstance(conv, nn.Conv1d | nn.Conv2d)
                precision = conv.weight.dtype
                setattr(parent, conv_name, fuse_conv_bn_eval(conv.double(), norm.double()).to(precision))
                setattr(parent, norm_name, nn.Identity())


def autocast(placement: Placement) -> torch.autocast:
    """For networks that are not ours: PyTorch decides what runs in half precision."""
    enabled = placement.precision is not Precision.FLOAT32
    return torch.autocast(torch.device(placement.device).type, dtype_of(placement), enabled)


def dtype_of(placement: Placement) -> torch.dtype:
    dtype: torch.dtype = getattr(torch, placement.precision)
    return dtype
