"""Linear maps and attention, fast on CPUs; for inference only.

A weight may be kept in half precision (see ``placement``): the product is then taken in it, and a linear map's
result has its input's precision again.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

IMAGES = 16  # on one thread PyTorch takes oneDNN's convolution from this batch size on


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """(..., C_in) times ``weight`` (C_out, C_in) plus ``bias`` (C_out,) -> (..., C_out)."""
    if weight.dtype != x.dtype:
        return functional.linear(x.to(weight.dtype), weight, bias).to(x.dtype)
    if x.device.type != "cpu" or weight.dtype != torch.float32 or x.numel() == 0:
        return functional.linear(x, weight, bias)
    # In float32 a 1x1 convolution by oneDNN: as fast as MKL's matrix product on Intel, twice as fast on AMD.
    rows = x.numel() // x.shape[-1]
    images = IMAGES if rows % IMAGES == 0 else 1
    seen = x.reshape(images, 1, rows // images, -1).permute(0, 3, 1, 2)  # channels last
    mapped = functional.conv2d(seen, weight[:, :, None, None], bias)  # (images, C_out, 1, rows / images)
    return mapped.permute(0, 2, 3, 1).reshape(*x.shape[:-1], -1)


class Linear(nn.Linear):
    """(..., C_in) -> (..., C_out)."""

    def forward(self, x: Tensor) -> Tensor:
        return linear(x, self.weight, self.bias)


class Exact:
    """Marks layers whose outputs are or select coordinates: they stay in float32 in any precision."""


class ExactLinear(Exact, Linear):
    pass


class ExactConv1d(Exact, nn.Conv1d):
    pass


class ExactConv2d(Exact, nn.Conv2d):
    pass


def attention(q: Tensor, k: Tensor, v: Tensor, precision: torch.dtype) -> Tensor:
    """softmax(q k^T / sqrt(D)) v of (B, heads, L, D) and (B, heads, S, D) twice -> (B, heads, L, D), like ``q``.

    The products are taken in ``precision``, the softmax in float32.
    """
    queries, keys, values = (x.to(precision) for x in (q, k, v))
    return functional.scaled_dot_product_attention(queries, keys, values).to(q.dtype)
