"""LoFTR with quadtree attention in its coarse transformer.

Sources: Tang et al., "QuadTree Attention for Vision Transformers", 2022 (type B); Sun et al. 2021
(LoFTR).
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.contract import Training
from mkpc_kaggle.matchers.networks.grids import (
    as_grid,
    as_map,
    from_2x2_blocks,
    mean_pool,
    pointwise,
    to_2x2_blocks,
)
from mkpc_kaggle.matchers.networks.layers import Linear
from mkpc_kaggle.matchers.networks.linear_attention import MaskPair
from mkpc_kaggle.matchers.networks.position import FIXED_DECAY, with_positions
from mkpc_kaggle.matchers.networks.resnet_fpn import TOP
from mkpc_kaggle.matchers.networks.semi_dense import HEADS, SemiDenseNetwork

LEVELS = 3  # of the tree: 1/32, 1/16 and 1/8 of the image
LAYERS = 8  # self, cross, self, cross, ...
HIDDEN = 4 * TOP  # channels inside a perceptron
# The number of key cells that each level keeps for the next, coarsest first; as published.
TOPKS = {Training.OUTDOOR: (16, 8), Training.INDOOR: (32, 16)}


def attend(q: Tensor, k: Tensor, v: Tensor, keep: int) -> tuple[Tensor, Tensor]:
    """Attend from P cells of G queries each to the cell's own S keys and values.

    Queries are (B, P, G, D), keys and values (B, P, S, D). Return messages (B, P, G, D) and the
    indices (B, P, G, keep) int64, below S, of the highest attention.
    """
    logits = (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)  # (B, P, G, S)
    # A small image may have fewer keys. The order of the kept ones has no effect.
    count = min(keep, logits.shape[-1])
    kept = logits.topk(count, dim=-1, sorted=False).indices
    # Messages come from all keys, not only from the kept ones (the paper's type B).
    return logits.softmax(dim=-1) @ v, kept


def attend_children(
    q: Tensor, k: Tensor, v: Tensor, parents: Tensor, keep: int
) -> tuple[Tensor, Tensor]:
    """Attend at a finer level from queries (B, h, w, D) to part of the keys and values.

    Keys and values are (B, h_key, w_key, D). A 2x2 block of queries attends to the children of
    ``parents`` (B, h w / 4, K) int64, key cells of the coarser level. Children of one parent are
    adjacent in memory, for one read. Return messages and indices as :func:`attend` does; indices
    count this level's key cells row by row.
    """
    w_key = k.shape[2]
    # Gathered once for the block's four queries: a gather per query would take four times as much.
    keys = _children_of(to_2x2_blocks(k), parents)  # (B, P, 4 K, D)
    values = _children_of(to_2x2_blocks(v), parents)
    message, kept = attend(to_2x2_blocks(q), keys, values, keep)

    # Candidate c is child c % 4 of the parent number c // 4.
    of_queries = parents[:, :, None].expand(-1, -1, 4, -1)  # (B, P, 4, K)
    parent = of_queries.gather(3, kept // 4)  # (B, P, 4, keep)
    row = parent // (w_key // 2) * 2 + kept % 4 // 2
    column = parent % (w_key // 2) * 2 + kept % 2
    return message, row * w_key + column


def _children_of(cells: Tensor, parents: Tensor) -> Tensor:
    """Gather the children (B, P, 4 K, D) of ``parents`` (B, P, K) from cells (B, S, 4, D).

    They are in order of their parents.
    """
    batch, count, four, width = cells.shape
    # One table for all heads, so that one read finds a parent's four children.
    table = cells.reshape(-1, four * width)  # (B S, 4 D)
    first = torch.arange(batch, device=cells.device)[:, None, None] * count
    found = table.index_select(0, (parents + first).flatten())
    return found.view(batch, parents.shape[1], -1, width)


def quadtree_attention(
    q: Tensor, k: Tensor, v: Tensor, shares: Tensor, topks: tuple[int, int]
) -> Tensor:
    """Map queries (B, h, w, D) of B heads to messages (B, h, w, D).

    Keys and values are (B, h_key, w_key, D). Sides are multiples of 4. The coarsest of three levels
    of mean pooling attends to all key cells. A finer level attends to the children of its parent's
    ``topks`` best cells. ``shares`` (3,) weight the levels' messages.
    """
    # The coarsest level: a single cell with all queries and all keys.
    q0 = mean_pool(q, 4)
    batch, h0, w0, width = q0.shape
    queries = q0.reshape(batch, 1, -1, width)  # (B, 1, h0 w0, D)
    keys = mean_pool(k, 4).flatten(1, 2)[:, None]
    values = mean_pool(v, 4).flatten(1, 2)[:, None]
    dense, kept = attend(queries, keys, values, topks[0])

    # The middle level: its messages are in 2x2 blocks, (B, h0 w0, 4, D).
    q1 = mean_pool(q, 2)
    k1 = mean_pool(k, 2)
    v1 = mean_pool(v, 2)
    middle, kept = attend_children(q1, k1, v1, kept[:, 0], topks[1])
    # The finest level: nothing reads its best cells.
    parents = from_2x2_blocks(kept, 2 * h0, 2 * w0).flatten(1, 2)  # (B, 4 h0 w0, K)
    fine, _ = attend_children(q, k, v, parents, 0)

    # Broadcasting over 2x2 blocks adds a cell's message to its children's.
    coarse = dense[:, 0, :, None] * shares[0]  # (B, h0 w0, 1, D)
    merged = from_2x2_blocks(
        coarse + middle * shares[1], 2 * h0, 2 * w0
    )  # (B, 2 h0, 2 w0, D)
    total = fine * shares[2] + merged.flatten(1, 2)[:, :, None]  # (B, 4 h0 w0, 4, D)
    return from_2x2_blocks(total, 4 * h0, 4 * w0)


class QuadtreeAttention(nn.Module):
    """Quadtree attention of all heads, with its projections."""

    def __init__(self, width: int, heads: int, topks: tuple[int, int]) -> None:
        super().__init__()
        self.heads = heads
        self.topks = topks
        self.q_proj = nn.Conv2d(width, width, 1, bias=False)
        self.k_proj = nn.Conv2d(width, width, 1, bias=False)
        self.v_proj = nn.Conv2d(width, width, 1, bias=False)
        # The levels' shares before the softmax, the coarsest level first.
        self.py_att = nn.ParameterDict({"weight": torch.ones(LEVELS)})
        self.proj = Linear(width, width)

    def forward(self, x: Tensor, source: Tensor) -> Tensor:
        """Map grids (N, h, w, C) and (N, h_source, w_source, C) to (N, h, w, C)."""
        q = self._by_head(pointwise(self.q_proj, x))  # (N heads, h, w, D)
        k = self._by_head(pointwise(self.k_proj, source))
        v = self._by_head(pointwise(self.v_proj, source))
        shares = self.py_att["weight"].softmax(dim=0)
        # On a CPU head by head, so that gathered keys fit the cache; on a GPU all at once.
        at_once = 1 if x.device.type == "cpu" else len(q)
        messages = []
        for first in range(0, len(q), at_once):
            part = slice(first, first + at_once)
            messages.append(quadtree_attention(q[part], k[part], v[part], shares, self.topks))
        message = torch.cat(messages)  # (N heads, h, w, D)
        heads = message.view(-1, self.heads, *q.shape[1:])
        merged = heads.permute(0, 2, 3, 1, 4).flatten(3)  # (N, h, w, C)
        out: Tensor = self.proj(merged)
        return out

    def _by_head(self, grid: Tensor) -> Tensor:
        """Map (N, h, w, C) to (N heads, h, w, D), contiguous."""
        split = grid.view(*grid.shape[:3], self.heads, -1)
        return split.permute(0, 3, 1, 2, 4).flatten(0, 1)


class ConvolutionalMlp(nn.Module):
    """A perceptron with a depthwise convolution over neighbouring cells."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = Linear(width, hidden)
        self.dwconv = nn.ModuleDict(
            {"dwconv": nn.Conv2d(hidden, hidden, 3, padding=1, groups=hidden)}
        )
        self.fc2 = Linear(hidden, width)

    def forward(self, grid: Tensor) -> Tensor:
        """Map (N, h, w, C) to (N, h, w, C)."""
        hidden = functional.relu_(
            self.fc1(grid.to(self.fc1.weight.dtype))
        )  # (N, h, w, hidden)
        mixed = as_grid(self.dwconv["dwconv"](as_map(hidden)))
        out: Tensor = self.fc2(functional.gelu(mixed))  # the exact GELU
        return out.to(grid.dtype)


class QuadtreeLayer(nn.Module):
    """An update of a grid from a source, both normalised first."""

    def __init__(self, width: int, heads: int, topks: tuple[int, int]) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width)
        self.attn = QuadtreeAttention(width, heads, topks)
        self.norm2 = nn.LayerNorm(width)
        self.mlp = ConvolutionalMlp(width, HIDDEN)

    def forward(self, x: Tensor, source: Tensor) -> Tensor:
        """Map grids (N, h, w, C) and (N, h_source, w_source, C) to (N, h, w, C)."""
        own = self.norm1(x)
        other = own if source is x else self.norm1(source)  # the same norm for both
        attended = x + self.attn(own, other)
        out: Tensor = attended + self.mlp(self.norm2(attended))
        return out


class QuadtreeTransformer(nn.Module):
    """Alternating self- and cross-attention; each layer updates both images at once."""

    def __init__(self, topks: tuple[int, int]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(QuadtreeLayer(TOP, HEADS, topks) for _ in range(LAYERS))

    def forward(
        self, coarse0: Tensor, coarse1: Tensor, masks: MaskPair | None = None
    ) -> tuple[Tensor, Tensor]:
        """Map (N, 256, h, w) of both images to (N, h, w, 256).

        As published, masks apply to the matching of coarse cells only, not to attention.
        """
        x0 = with_positions(coarse0, FIXED_DECAY)
        x1 = with_positions(coarse1, FIXED_DECAY)
        for index, layer in enumerate(self.layers):
            crossed = index % 2 == 1
            source0 = x1 if crossed else x0
            source1 = x0 if crossed else x1
            updated0 = layer(x0, source0)
            updated1 = layer(x1, source1)  # from image 0 before its update, unlike LoFTR
            x0 = updated0
            x1 = updated1
        return x0, x1


class Quadtree(SemiDenseNetwork):
    """LoFTR with quadtree attention. Sides are multiples of 32; two images may differ in size.

    The published code needs two images of one size.
    """

    def __init__(self, training: Training = Training.OUTDOOR) -> None:
        super().__init__(QuadtreeTransformer(TOPKS[training]))
