"""Linear maps, attention, convolutions in strips and mutual matches, fast on CPUs; for inference
only.

A weight may have half precision (see ``placement``). The product is then computed in half
precision, and a linear map converts the result back to the input's precision.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

STRIP_FLOATS = 2**21  # of a strip of :func:`in_strips`, at its maximum number of channels
IMAGES = range(16, 65)  # on one thread PyTorch uses oneDNN's convolution from 16 images on


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Map (..., C_in) to (..., C_out): multiply by ``weight`` (C_out, C_in), and add ``bias``
    (C_out,).
    """
    if weight.dtype != x.dtype:
        return functional.linear(x.to(weight.dtype), weight, bias).to(x.dtype)
    if x.device.type != "cpu" or weight.dtype != torch.float32 or x.numel() == 0:
        return functional.linear(x, weight, bias)
    # In float32 oneDNN's 1x1 convolution is as fast as MKL's matrix product on Intel, twice as fast
    # on AMD.
    rows = x.numel() // x.shape[-1]
    images = next((count for count in IMAGES if rows % count == 0), 1)
    seen = x.reshape(images, 1, rows // images, -1).permute(0, 3, 1, 2)  # channels last
    # (images, C_out, 1, rows / images)
    mapped = functional.conv2d(seen, weight[:, :, None, None], bias)
    return mapped.permute(0, 2, 3, 1).reshape(*x.shape[:-1], -1)


class Linear(nn.Linear):
    """A linear map from (..., C_in) to (..., C_out), by :func:`linear`."""

    def forward(self, x: Tensor) -> Tensor:
        return linear(x, self.weight, self.bias)


class Exact:
    """A mark of layers that output or select coordinates. These layers stay float32 in any
    precision.
    """


class ExactLinear(Exact, Linear):
    pass


class ExactConv1d(Exact, nn.Conv1d):
    pass


class ExactConv2d(Exact, nn.Conv2d):
    pass


def depthwise_block(inputs: int, outputs: int) -> nn.Sequential:
    """Make a depthwise 5x5 convolution of ``inputs`` channels, then a 1x1 convolution of
    ``outputs``.
    """
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 5, padding=2, groups=inputs),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
        nn.Conv2d(outputs, outputs, 1),
    )


def resize(x: Tensor, size: torch.Size, mode: str = "bilinear") -> Tensor:
    """Resize (B, C, h, w) to (B, C, *size) with half-pixel centres, without antialiasing."""
    return functional.interpolate(x, tuple(size), mode=mode, align_corners=False)


def attention(q: Tensor, k: Tensor, v: Tensor, precision: torch.dtype) -> Tensor:
    """Return softmax(q k^T / sqrt(D)) v, like q (B, heads, L, D); k and v are (B, heads, S, D).

    Products are computed in ``precision``, the softmax in float32.
    """
    queries, keys, values = (x.to(precision) for x in (q, k, v))
    return functional.scaled_dot_product_attention(queries, keys, values).to(q.dtype)


def in_strips(
    function: Callable[[Tensor], Tensor], x: Tensor, *, reach: int, channels: int
) -> Tensor:
    """Map (B, C, H, W) to (B, C', H, W) by ``function``; on a CPU, in strips of rows that fit the
    cache.

    A row of the result depends on ``reach`` rows above and below it. ``channels``: the maximum
    number of channels inside the function. The function must not change ``x``. Strips overlap by
    the reach, so that zero padding at their edges has no effect.
    """
    batch, _, height, width = x.shape
    rows = max(1, 4 * reach, STRIP_FLOATS // (batch * channels * width))
    if x.is_cuda or rows >= height:
        return function(x)
    strips = []
    for top in range(0, height, rows):
        bottom, first = min(top + rows, height), max(0, top - reach)
        strips.append(function(x[:, :, first : bottom + reach])[:, :, top - first : bottom - first])
    return torch.cat(strips, dim=2).contiguous(memory_format=torch.channels_last)


class Assignment(NamedTuple):
    """M matches by ascending ``index0``: indices (M,) int64 of keypoints or cells, ``scores`` (M,)
    in 0..1.
    """

    index0: Tensor
    index1: Tensor
    scores: Tensor

    @classmethod
    def empty(cls, device: torch.device) -> "Assignment":
        index = torch.zeros(0, dtype=torch.int64, device=device)
        return cls(index, index, torch.zeros(0, device=device))


def mutual_matches(log_scores: Tensor, threshold: float) -> Assignment:
    """Return pairs of keypoints that are mutually best in ``log_scores`` (N0, N1), scored above the
    threshold.
    """
    # (N0,) twice, (N1,)
    (best0, partner0), partner1 = log_scores.max(dim=1), log_scores.argmax(dim=0)
    index0, scores = torch.arange(len(partner0), device=log_scores.device), best0.exp()
    kept = (partner1[partner0] == index0) & (scores > threshold)
    return Assignment(index0[kept], partner0[kept], scores[kept])
