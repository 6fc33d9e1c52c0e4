"""Linear maps and attention, fast on CPUs; for inference only.

A weight may be kept in half precision (see ``placement``): the product is then taken in it, and a linear map's
result has its input's precision again.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

ROWS_AT_ONCE = 256  # of an attention matrix, which then stays in a CPU's cache
IMAGES = 16  # on one thread PyTorch takes oneDNN's convolution from this batch size on


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """(..., C_in) times ``weight`` (C_out, C_in) plus ``bias`` (C_out,) -> (..., C_out)."""
    if weight.dtype != x.dtype:
        return functional.linear(x.to(weight.dtype), weight, bias).to(x.dtype)
    if x.device.type != "cpu" or weight.dtype != torch.float32 or x.numel() == 0:
        return functional.linear(x, weight, bias)
    # In float32 a 1x1 convolution by oneDNN: MKL's matrix product takes twice as long on AMD.
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
    if q.device.type != "cpu":
        queries, keys, values = (x.to(precision) for x in (q, k, v))
        return functional.scaled_dot_product_attention(queries, keys, values).to(q.dtype)
    # Faster than PyTorch's, which multiplies by MKL.
    outputs = torch.empty_like(q, memory_format=torch.contiguous_format)
    scaled, keys, values = q * q.shape[-1] ** -0.5, k.to(precision), v.mT.to(precision)
    for head in zip(*(x.flatten(0, 1) for x in (scaled, keys, values, outputs)), strict=True):
        queries, keys, values, out = head
        for some, output in zip(queries.split(ROWS_AT_ONCE), out.split(ROWS_AT_ONCE), strict=True):
            output.copy_(linear(linear(some, keys).softmax(dim=1), values))
    return outputs
