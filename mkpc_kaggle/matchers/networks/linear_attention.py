"""The transformer with linear attention, of LoFTR and its descendants.

LoFTR's coarse stage uses it, and the fine stage of all of them.
Sources: Sun et al. 2021, section 3.2; Katharopoulos et al. 2020 (linear attention).
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.networks.grids import Perceptron
from mkpc_kaggle.matchers.networks.layers import Linear

MaskPair = tuple[Tensor, Tensor]


def linear_attention(
    q: Tensor, k: Tensor, v: Tensor, heads: int, masks: MaskPair | None = None
) -> Tensor:
    """Map queries (N, L, C), keys and values (N, S, C) to (N, L, C); heads have adjacent channels.

    ``masks`` of queries (N, L) and of keys (N, S) are True at content. A masked query's output is
    zero, and a masked key has no effect. ``q`` and ``k`` are overwritten.
    """
    # elu + 1 is positive; it stands for the exponential of softmax attention (Katharopoulos, 3.2).
    q = functional.elu(q, inplace=True).add_(1.0)
    k = functional.elu(k, inplace=True).add_(1.0)
    if masks is not None:
        query_mask, key_mask = masks
        q = q.mul_(query_mask[..., None])
        k = k.mul_(key_mask[..., None])

    q = _by_head(q, heads)  # (N, heads, L, D)
    k = _by_head(k, heads)  # (N, heads, S, D)
    v = _by_head(v, heads)
    # Keys and values are summed first: the cost is linear in L and S. Published code divides the
    # values by S here and multiplies the result by S, against overflow in half precision; in
    # float32 nothing overflows.
    summary = k.transpose(2, 3) @ v  # (N, heads, D, D)
    total = q @ k.sum(dim=2)[..., None]  # (N, heads, L, 1)
    attended: Tensor = q @ summary / (total + 1e-6)  # (N, heads, L, D)
    return attended.transpose(1, 2).flatten(2)


def _by_head(x: Tensor, heads: int) -> Tensor:
    """Map (N, L, C) to (N, heads, L, D), a view."""
    # No -1 for the width: a pair without matches has no windows, and N is 0.
    width = x.shape[2] // heads
    return x.view(*x.shape[:2], heads, width).transpose(1, 2)


class EncoderLayer(nn.Module):
    """An update of tokens from a source: attention, then a perceptron on tokens and messages."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.q_proj = Linear(width, width, bias=False)
        self.k_proj = Linear(width, width, bias=False)
        self.v_proj = Linear(width, width, bias=False)
        self.merge = Linear(width, width, bias=False)
        self.mlp = Perceptron(
            Linear(2 * width, 2 * width, bias=False),
            Linear(2 * width, width, bias=False),
        )
        self.norm1 = nn.LayerNorm(width)
        self.norm2 = nn.LayerNorm(width)

    def forward(self, x: Tensor, source: Tensor, masks: MaskPair | None = None) -> Tensor:
        """Update tokens (N, L, C) from a source (N, S, C); masks are (N, L) and (N, S)."""
        # One cast instead of one per projection. The sums stay float32.
        seen = x.to(self.q_proj.weight.dtype)
        other = seen if source is x else source.to(seen.dtype)
        q = self.q_proj(seen).float()
        k = self.k_proj(other).float()
        v = self.v_proj(other).float()
        attended = linear_attention(q, k, v, self.heads, masks)
        message = self.norm1(self.merge(attended))  # (N, L, C)

        both = torch.cat([seen, message.to(seen.dtype)], dim=2)  # (N, L, 2 C), tokens first
        update: Tensor = self.norm2(self.mlp(both).float())
        # No norm on the residual path.
        return update.add_(x)


class LinearTransformer(nn.Module):
    """``cycles`` of a self-attention and a cross-attention layer. Both images share each layer.

    Cross attention runs in sequence: image 1 is updated from the updated image 0.
    """

    def __init__(self, width: int, heads: int, cycles: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(EncoderLayer(width, heads) for _ in range(2 * cycles))

    def forward(
        self, x0: Tensor, x1: Tensor, masks: MaskPair | None = None
    ) -> tuple[Tensor, Tensor]:
        """Map (N, L, C) and (N, S, C) to the same shapes; masks (N, L) and (N, S) mark content."""
        # Of the updated image, then of the source.
        own0 = own1 = cross0 = cross1 = None
        if masks is not None:
            mask0, mask1 = masks
            own0 = (mask0, mask0)
            own1 = (mask1, mask1)
            cross0 = (mask0, mask1)
            cross1 = (mask1, mask0)
        for index, layer in enumerate(self.layers):
            if index % 2 == 0:
                x0 = layer(x0, x0, own0)
                x1 = layer(x1, x1, own1)
            else:
                x0 = layer(x0, x1, cross0)
                # From the updated image 0, as published.
                x1 = layer(x1, x0, cross1)
        return x0, x1
