"""Matches of coarse cells: dual softmax, mutual nearest neighbours, threshold and border.

Source: Sun et al. 2021, section 3.3. Only one matrix of all pairs of cells is ever held.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from mkpc_kaggle.matchers.networks.linear_attention import Masks

ROWS_AT_ONCE = 512


@dataclass(frozen=True, eq=False)
class CoarseMatches:
    """M matches in order of (batch, cell0): int64 ``batch``, ``cell0``, ``cell1`` and float32 ``confidence``.

    A cell is counted row by row over its own map.
    """

    batch: Tensor
    cell0: Tensor
    cell1: Tensor
    confidence: Tensor


def coarse_matches(
    grid0: Tensor, grid1: Tensor, scale: float | Tensor, threshold: float, border: int, masks: Masks | None
) -> CoarseMatches:
    """Grids (N, h0, w0, C) and (N, h1, w1, C), whose similarity is ``scale`` times their dot product.

    A match is above ``threshold`` and the best of its row and of its column, border cells included; then those
    with a cell within ``border`` of the border of its content go. ``masks``: (N, h, w) bool, True at content.
    """
    level = log_root_confidence(similarity(grid0, grid1, scale, masks))  # (N, L, S)
    best0, partner = level.max(dim=2)  # (N, L)
    best1 = level.amax(dim=1)  # (N, S)
    inner0 = inner_cells(grid0, border, masks and masks[0])  # (N, L)
    inner1 = inner_cells(grid1, border, masks and masks[1])  # (N, S)
    confidence = torch.exp(2 * best0)
    kept = (confidence > threshold) & (best0 == best1.gather(1, partner)) & inner0 & inner1.gather(1, partner)
    batch, cell0 = kept.nonzero(as_tuple=True)
    return CoarseMatches(batch, cell0, partner[batch, cell0], confidence[batch, cell0])


def similarity(grid0: Tensor, grid1: Tensor, scale: float | Tensor, masks: Masks | None) -> Tensor:
    """(N, L, S) float32: scaled dot products, minus infinity where either cell is padding."""
    tokens0, tokens1 = grid0.float().flatten(1, 2), grid1.float().flatten(1, 2)
    matrix = (tokens0 * scale) @ tokens1.transpose(1, 2)
    if masks is not None:
        matrix.masked_fill_(~masks[0].flatten(1)[:, :, None], -torch.inf)
        matrix.masked_fill_(~masks[1].flatten(1)[:, None, :], -torch.inf)
    return matrix


def log_root_confidence(matrix: Tensor) -> Tensor:
    """Similarity (N, L, S), overwritten -> half the logarithm of the confidence.

    The confidence is the softmax over the rows times that over the columns, so its logarithm is
    2 s_ij - log sum_j exp s_ij - log sum_i exp s_ij.
    """
    blocks = torch.split(matrix, ROWS_AT_ONCE, dim=1)  # a log-sum-exp makes a copy of what it is given
    over_rows = torch.cat([block.logsumexp(dim=2) for block in blocks], dim=1)  # (N, L)
    over_columns = torch.stack([block.logsumexp(dim=1) for block in blocks]).logsumexp(dim=0)  # (N, S)
    finite = torch.finfo(matrix.dtype).min  # a row of padding alone sums to nothing; keep it at minus infinity
    matrix.sub_(over_rows.clamp_(min=finite).div_(2)[:, :, None])
    return matrix.sub_(over_columns.clamp_(min=finite).div_(2)[:, None, :])


def inner_cells(grid: Tensor, border: int, mask: Tensor | None) -> Tensor:
    """(N, h w) bool: content cells at least ``border`` away from the border of the content."""
    batch, h, w = grid.shape[:3]
    if mask is None:
        mask = torch.ones((batch, h, w), dtype=torch.bool, device=grid.device)
    bottom = mask.sum(dim=1).amax(dim=1)[:, None, None] - border  # (N, 1, 1)
    right = mask.sum(dim=2).amax(dim=1)[:, None, None] - border
    row = torch.arange(h, device=grid.device)[None, :, None]
    column = torch.arange(w, device=grid.device)[None, None, :]
    inner = (row >= border) & (row < bottom) & (column >= border) & (column < right)
    return (inner & mask).flatten(1)
