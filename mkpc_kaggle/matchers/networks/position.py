"""The sine position encoding of LoFTR and its descendants (Sun et al. 2021, after Carion et al.
2020).
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
    """Return (height, width, 256) float32: for each g = 0..63, sine and cosine of x w_g, then of y
    w_g.

    w_g = exp(-2 g decay); x and y are the column and row counted from one, times ``scale`` (y, x).
    """
    # (64,)
    frequency = torch.exp(
        torch.arange(0, CHANNELS // 2, 2, dtype=torch.float32, device=device) * -decay
    )
    # (height, width, 64, 2)
    y = _waves(height, scale[0], frequency)[:, None].expand(-1, width, -1, -1)
    x = _waves(width, scale[1], frequency).expand(height, -1, -1, -1)  # (height, width, 64, 2)
    return torch.cat([x, y], dim=-1).flatten(2)


def with_positions(coarse: Tensor, decay: float) -> Tensor:
    """Map a coarse map (N, 256, h, w) to a contiguous grid (N, h, w, 256), with position encodings
    added.
    """
    grid = as_grid(coarse)
    _, height, width, _ = grid.shape
    return (grid + sine_positions(height, width, decay, device=grid.device)).contiguous()


def _waves(length: int, scale: float, frequency: Tensor) -> Tensor:
    """Return (length, 64, 2): sine and cosine at each position of one axis."""
    positions = torch.arange(1, length + 1, dtype=torch.float32, device=frequency.device) * scale
    angles = positions[:, None] * frequency
    return torch.stack([angles.sin(), angles.cos()], dim=-1)
