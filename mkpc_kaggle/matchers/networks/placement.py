"""Makes a loaded network ready to run: batch norms folded, on its device, in its precision."""

from itertools import pairwise
from typing import TypeVar

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

Network = TypeVar("Network", bound=nn.Module)

Norm = nn.BatchNorm1d | nn.BatchNorm2d
Layer = nn.Linear | nn.Conv1d | nn.Conv2d


def placed(network: Network, device: str = "cpu", precision: torch.dtype = torch.float32) -> Network:
    """The network, changed in place. After it no checkpoint loads any more.

    In half precision are the weights of convolutions and linear layers, and so the maps between convolutions; all
    else (what transformers add up, softmax, transport, coordinates) stays float32.
    """
    fold_norms(network)
    for layer in network.modules():
        if isinstance(layer, Layer):
            layer.to(precision)
    return network.to(device)


def fold_norms(network: nn.Module) -> None:
    """Every batch norm goes into the convolution before it; computed in float64, rounded once."""
    for parent in list(network.modules()):
        for (conv_name, conv), (norm_name, norm) in pairwise(list(parent.named_children())):
            if isinstance(norm, Norm):
                assert isinstance(conv, nn.Conv1d | nn.Conv2d)
                precision = conv.weight.dtype
                setattr(parent, conv_name, fuse_conv_bn_eval(conv.double(), norm.double()).to(precision))
                setattr(parent, norm_name, nn.Identity())
