"""Linear maps, attention, convolutions in strips and mutual matches, fast on CPUs.

For inference only. A weight may have half precision (see ``placement``). The product is then
computed in half precision, and a linear map converts the result back to the input's precision.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

STRIP_FLOATS = 2**21  # of a strip of :func:`in_strips`, at its maximum number of channels
IMAGES = range(16, 65)  # on one thread PyTorch uses oneDNN's convolution from 16 images on


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Map (..., C_in) to (..., C_out) by ``weight`` (C_out, C_in) and ``bias`` (C_out,)."""
    if weight.dtype != x.dtype:
        return functional.linear(x.to(weight.dtype), weight, bias).to(x.dtype)
    # Zero rows, of images without keypoints, cannot be split into images below.
    if x.device.type != "cpu" or weight.dtype != torch.float32 or x.numel() == 0:
        return functional.linear(x, weight, bias)

    # In float32 oneDNN's 1x1 convolution is as fast as MKL's matrix product on Intel, and twice as
    # fast on AMD. The rows become the pixels of ``images`` images with one line each.
    rows = x.numel() // x.shape[-1]
    images = next((count for count in IMAGES if rows % count == 0), 1)
    lines = x.reshape(images, 1, rows // images, -1)  # (images, 1, rows / images, C_in)
    pixels = lines.permute(
        0, 3, 1, 2
    )  # a view: channels last in memory, so nothing is copied
    kernel = weight[:, :, None, None]  # (C_out, C_in, 1, 1)
    mapped = functional.conv2d(pixels, kernel, bias)  # (images, C_out, 1, rows / images)
    as_lines = mapped.permute(0, 2, 3, 1)
    return as_lines.reshape(*x.shape[:-1], -1)


class Linear(nn.Linear):
    """A linear map from (..., C_in) to (..., C_out), by :func:`linear`."""

    def forward(self, x: Tensor) -> Tensor:
        return linear(x, self.weight, self.bias)


class Exact:
    """A mark of layers that output or select coordinates: they stay float32 in any precision."""


class ExactLinear(Exact, Linear):
    pass


class ExactConv1d(Exact, nn.Conv1d):
    pass


class ExactConv2d(Exact, nn.Conv2d):
    pass


def depthwise_block(inputs: int, outputs: int) -> nn.Sequential:
    """Make a depthwise 5x5 convolution of ``inputs`` channels and a 1x1 convolution.

    The depthwise one has ``outputs`` channels, a multiple of ``inputs``, and so has the other.
    """
    # The order of DKM's and LoMa's checkpoints: 0 depthwise, 1 norm, 2 ReLU, 3 pointwise.
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 5, padding=2, groups=inputs),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
        nn.Conv2d(outputs, outputs, 1),
    )


def resize(x: Tensor, size: torch.Size, mode: str = "bilinear") -> Tensor:
    """Resize (B, C, h, w) to (B, C, *size) with half-pixel centres, without antialiasing.

    ``mode``: "bilinear", "bicubic" or "nearest".
    """
    # PyTorch accepts no ``align_corners`` for "nearest".
    align_corners = None if mode == "nearest" else False
    return functional.interpolate(x, tuple(size), mode=mode, align_corners=align_corners)


def attention(q: Tensor, k: Tensor, v: Tensor, precision: torch.dtype) -> Tensor:
    """Return softmax(q k^T / sqrt(D)) v, like q (B, heads, L, D); k and v are (B, heads, S, D).

    Products are computed in ``precision``, the softmax in float32.
    """
    # Fused: the (L, S) logits, 67 MB at 2,048 keypoints and 4 heads, are never stored.
    outputs = functional.scaled_dot_product_attention(
        q.to(precision), k.to(precision), v.to(precision)
    )
    return outputs.to(q.dtype)


def in_strips(
    function: Callable[[Tensor], Tensor], x: Tensor, *, reach: int, channels: int
) -> Tensor:
    """Map (B, C, H, W) to (B, C', H, W) by ``function``; on a CPU in strips that fit the cache.

    A row of the result depends on ``reach`` rows above and below it. ``channels``: the maximum
    number of channels inside the function. The function must not change ``x``, since strips
    overlap.
    """
    batch, _, height, width = x.shape
    rows = STRIP_FLOATS // (batch * channels * width)
    # Twice the reach is computed again for each strip: at most half of its rows.
    rows = max(1, 4 * reach, rows)
    if x.is_cuda or rows >= height:
        return function(x)
    strips = []
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        # The rows that zero padding at the strip's edges has changed are cut off again.
        first = max(0, top - reach)
        mapped = function(x[:, :, first : bottom + reach])
        strips.append(mapped[:, :, top - first : bottom - first])
    # Channels last, like the maps that ``function`` returns without strips.
    return torch.cat(strips, dim=2).contiguous(memory_format=torch.channels_last)


class Assignment(NamedTuple):
    """M matches by ascending ``index0``: indices (M,) int64 of keypoints or cells, and scores.

    ``scores`` (M,) are float32 in 0..1.
    """

    index0: Tensor
    index1: Tensor
    scores: Tensor

    @classmethod
    def empty(cls, device: torch.device) -> "Assignment":
        index = torch.zeros(0, dtype=torch.int64, device=device)
        return cls(index, index, torch.zeros(0, device=device))


def mutual_matches(log_scores: Tensor, threshold: float) -> Assignment:
    """Return mutually best pairs of ``log_scores`` (N0, N1) with a score above ``threshold``."""
    best0, partner0 = log_scores.max(
        dim=1
    )  # (N0,): the best score, and its keypoint in image 1
    partner1 = log_scores.argmax(dim=0)  # (N1,)
    scores = best0.exp()
    index0 = torch.arange(len(partner0), device=log_scores.device)
    is_mutual = partner1[partner0] == index0
    kept = is_mutual & (scores > threshold)
    return Assignment(index0[kept], partner0[kept], scores[kept])
