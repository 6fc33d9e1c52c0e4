"""Preparation of a loaded network for inference: batch norms, device and precision."""

from itertools import pairwise
from typing import TypeVar

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from mkpc_kaggle.matchers.contract import Placement, Precision
from mkpc_kaggle.matchers.networks.grids import Layer
from mkpc_kaggle.matchers.networks.layers import Exact

Network = TypeVar("Network", bound=nn.Module)

Norm = nn.BatchNorm1d | nn.BatchNorm2d


def prepared(network: Network, placement: Placement) -> Network:
    """Prepare the network in place, and return it; checkpoints cannot be loaded afterwards.

    The weights of convolutions and linear layers, except :class:`Exact` ones, and the maps between
    convolutions get the placement's precision. All else stays float32: sums of transformers,
    softmax, optimal transport, coordinates.
    """
    # Before the cast, so that folded weights are rounded to half precision once.
    fold_norms(network)
    for layer in network.modules():
        if isinstance(layer, Layer) and not isinstance(layer, Exact):
            for parameter in layer.parameters(recurse=False):
                parameter.data = parameter.to(dtype_of(placement))
    return network.to(placement.device)


def fold_norms(network: nn.Module) -> None:
    """Fold every batch norm into the convolution before it, in float64, rounded once at the end."""
    # Lists, because the loop replaces modules. Children are in the order of their definition: in
    # all networks a norm follows its convolution.
    for parent in list(network.modules()):
        children = list(parent.named_children())
        for (conv_name, conv), (norm_name, norm) in pairwise(children):
            if not isinstance(norm, Norm):
                continue
            assert isinstance(conv, nn.Conv1d | nn.Conv2d)
            precision = conv.weight.dtype
            folded = fuse_conv_bn_eval(conv.double(), norm.double())
            setattr(parent, conv_name, folded.to(precision))
            setattr(parent, norm_name, nn.Identity())


def autocast(placement: Placement) -> torch.autocast:
    """Return an autocast for libraries' networks, whose layers :func:`prepared` cannot know.

    PyTorch chooses the operators that run in half precision.
    """
    enabled = placement.precision is not Precision.FLOAT32
    device = torch.device(placement.device).type
    return torch.autocast(device, dtype_of(placement), enabled)


def dtype_of(placement: Placement) -> torch.dtype:
    dtype: torch.dtype = getattr(torch, placement.precision)
    return dtype
