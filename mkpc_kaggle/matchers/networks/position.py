"""The sine position encoding of LoFTR and its descendants (Sun et al. 2021).

It follows Carion et al. 2020, "End-to-End Object Detection with Transformers".
"""

import math

import torch
from torch import Tensor

from mkpc_kaggle.matchers.networks.grids import as_grid

CHANNELS = 256

# Decay of the frequencies. In the encoding of LoFTR's first checkpoints a floor division makes the
# exponent -1, so that all but the first frequencies vanish. Later checkpoints have the intended
# decay.
ORIGINAL_DECAY = 1.0
FIXED_DECAY = math.log(10000.0) / (CHANNELS // 2)


def sine_positions(
    height: int,
    width: int,
    decay: float,
    scale: tuple[float, float] = (1.0, 1.0),
    device: torch.device | None = None,
) -> Tensor:
    """Return (height, width, 256) float32: sine and cosine of x w_g and of y w_g for g = 0..63.

    w_g = exp(-2 g decay); x and y are the column and row counted from one, times ``scale`` (y, x).
    """
    even = torch.arange(0, CHANNELS // 2, 2, dtype=torch.float32, device=device)  # 2 g
    frequency = torch.exp(even * -decay)  # (64,)
    rows = _waves(height, scale[0], frequency)  # (height, 64, 2)
    columns = _waves(width, scale[1], frequency)  # (width, 64, 2)
    y = rows[:, None].expand(-1, width, -1, -1)  # (height, width, 64, 2)
    x = columns.expand(height, -1, -1, -1)  # (height, width, 64, 2)
    # Channels 4 g to 4 g + 3: sine and cosine of x, then sine and cosine of y.
    return torch.cat([x, y], dim=-1).flatten(2)


def with_positions(coarse: Tensor, decay: float) -> Tensor:
    """Add positions to a coarse map (N, 256, h, w): return a contiguous grid (N, h, w, 256)."""
    grid = as_grid(coarse)
    _, height, width, _ = grid.shape
    positions = sine_positions(height, width, decay, device=grid.device)
    # Transformers flatten the grid to tokens by ``view``, which needs contiguous memory.
    return (grid + positions).contiguous()


def _waves(length: int, scale: float, frequency: Tensor) -> Tensor:
    """Return (length, 64, 2): sine and cosine at each position of one axis."""
    # Published positions count from one, and are scaled after that.
    positions = (
        torch.arange(1, length + 1, dtype=torch.float32, device=frequency.device) * scale
    )
    angles = positions[:, None] * frequency  # (length, 64)
    return torch.stack([angles.sin(), angles.cos()], dim=-1)
