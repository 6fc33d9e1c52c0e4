"""Runs convolutions of large maps on strips of rows, which fit a processor's cache and take less memory."""

from collections.abc import Callable

import torch
from torch import Tensor

FLOATS = 2**21  # of a strip, where it has most channels


def in_strips(function: Callable[[Tensor], Tensor], x: Tensor, *, reach: int, channels: int) -> Tensor:
    """``function(x)``, a map (B, C', H, W) from (B, C, H, W), computed strip by strip on a CPU.

    A row of the result depends on ``reach`` rows above and below it; ``channels`` are the most that maps inside
    the function have. The function must not change its argument. Strips overlap by the reach, and the zeros that
    convolutions add at a strip's edges do not get further.
    """
    batch, _, height, width = x.shape
    rows = max(4 * reach, FLOATS // (batch * channels * width))
    if x.is_cuda or rows >= height:
        return function(x)
    result = None
    for top in range(0, height, rows):
        bottom, first = min(top + rows, height), max(0, top - reach)
        strip = function(x[:, :, first : bottom + reach])[:, :, top - first : bottom - first]
        if result is None:
            shape = (batch, strip.shape[1], height, width)
            result = strip.new_empty(shape).contiguous(memory_format=torch.channels_last)
        result[:, :, top:bottom] = strip
    assert result is not None
    return result
