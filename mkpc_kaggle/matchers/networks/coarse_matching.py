"""Matches of coarse cells: dual softmax, mutual nearest neighbours, threshold and border.

Source: Sun et al. 2021, section 3.3. The matrix of all pairs of cells is stored only if it is
small: at 1600 x 1200 pixels it would take 3.6 GB. Otherwise blocks of rows are computed twice,
first for the sums of the softmaxes, then for the maximum of each row and column.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from mkpc_kaggle.matchers.networks.layers import Assignment, linear
from mkpc_kaggle.matchers.networks.linear_attention import MaskPair

ROWS_AT_ONCE = {"cpu": 256, "cuda": 8192}
HELD_FLOATS = 2**25  # of the largest stored matrix: 128 MiB; 640 x 480 pixels need 23 million


def coarse_matches(
    grid0: Tensor,
    grid1: Tensor,
    scale: float | Tensor,
    threshold: float,
    border: int,
    masks: MaskPair | None,
) -> Assignment:
    """Match grids (h0, w0, C) and (h1, w1, C); similarities are ``scale`` times dot products.

    A match has a confidence above ``threshold``, the best of its row and column, border cells
    included. Then matches with a cell within ``border`` of the content's border are dropped.
    ``masks`` (h, w) bool are True at content. Indices of matched cells count row by row in the
    cell's own grid.
    """
    if masks is None:
        mask0 = grid0.new_ones(grid0.shape[:2], dtype=torch.bool)
        mask1 = grid1.new_ones(grid1.shape[:2], dtype=torch.bool)
    else:
        mask0, mask1 = masks
    features0 = grid0.flatten(0, 1) * scale  # (L, C)
    features1 = grid1.flatten(0, 1)  # (S, C)
    cells = Cells(features0, features1, mask0.flatten(), mask1.flatten())

    # The maxima include border cells, which therefore may suppress an inner cell, as published.
    best0, partner, best1 = row_and_column_maxima(cells)
    inner0 = inner_cells(mask0, border)
    inner1 = inner_cells(mask1, border)
    confidence = torch.exp(2 * best0)
    # Equality is exact: both maxima are read from the same number of the matrix.
    is_mutual = best0 == best1[partner]
    kept = (confidence > threshold) & is_mutual & inner0 & inner1[partner]
    cell0 = kept.nonzero()[:, 0]
    return Assignment(cell0, partner[cell0], confidence[cell0])


class Cells(NamedTuple):
    """The coarse cells of a pair: features (L, C) and (S, C), content (L,) and (S,) bool."""

    features0: Tensor
    features1: Tensor
    content0: Tensor
    content1: Tensor

    def similarity(self) -> Iterator[Tensor]:
        """Yield dot products in blocks of rows (l, S) float32; minus infinity at padding."""
        rows = ROWS_AT_ONCE.get(self.features0.device.type, 256)
        # In float32, since half precision has three digits and logits reach 100.
        features = torch.split(self.features0.float(), rows)
        contents = torch.split(self.content0, rows)
        keys = self.features1.float()
        for queries, content in zip(features, contents, strict=True):
            products = linear(queries, keys)
            if not (content.all() and self.content1.all()):
                is_content = content[:, None] & self.content1
                products.masked_fill_(~is_content, -torch.inf)
            yield products


def half_log_sums(blocks: Iterable[Tensor]) -> tuple[Tensor, Tensor]:
    """Return half the logsumexp of each row (L,) and column (S,) of a matrix.

    The matrix comes in blocks of rows (l, S).
    """
    of_rows = []
    of_columns = []
    for block in blocks:
        of_rows.append(block.logsumexp(dim=1))
        of_columns.append(block.logsumexp(dim=0))
    over_rows = torch.cat(of_rows)
    over_columns = torch.stack(of_columns).logsumexp(dim=0)
    # The logarithm for a row of padding is minus infinity. Clamping prevents NaN in later
    # differences.
    finite = torch.finfo(torch.float32).min
    half_rows = over_rows.clamp_(min=finite).div_(2)
    half_columns = over_columns.clamp_(min=finite).div_(2)
    return half_rows, half_columns


def half_log_confidences(cells: Cells) -> Iterator[Tensor]:
    """Yield half the logarithm of the confidence, in blocks of rows (l, S).

    The confidence is the product of the softmaxes over rows and columns. Its logarithm is 2 s_ij -
    log sum_j exp s_ij - log sum_i exp s_ij. Half of it takes one pass less over the matrix.
    """
    small = len(cells.features0) * len(cells.features1) <= HELD_FLOATS
    # A large matrix is computed twice instead of being stored.
    held = list(cells.similarity()) if small else None
    over_rows, over_columns = half_log_sums(held or cells.similarity())
    first = 0
    for block in held or cells.similarity():
        yield block.sub_(over_rows[first : first + len(block), None]).sub_(over_columns)
        first += len(block)


def row_and_column_maxima(cells: Cells) -> tuple[Tensor, Tensor, Tensor]:
    """Return each row's maximum (L,) and its column (L,), and each column's maximum (S,)."""
    of_rows = []
    partners = []
    of_columns = cells.features1.new_full(
        cells.content1.shape, -torch.inf, dtype=torch.float32
    )
    for block in half_log_confidences(cells):
        best, partner = block.max(dim=1)
        of_rows.append(best)
        partners.append(partner)
        of_columns = torch.maximum(of_columns, block.amax(dim=0))
    return torch.cat(of_rows), torch.cat(partners), of_columns


def inner_cells(mask: Tensor, border: int) -> Tensor:
    """Return (h w,) bool: True at cells of the content (h, w) at least ``border`` from its edge."""
    h, w = mask.shape
    # The content is at the top left: its height and width are the longest column and row.
    bottom = mask.sum(dim=0).amax() - border
    right = mask.sum(dim=1).amax() - border
    row = torch.arange(h, device=mask.device)[:, None]
    column = torch.arange(w, device=mask.device)
    inner = (row >= border) & (row < bottom) & (column >= border) & (column < right)
    return (inner & mask).flatten()
