"""The transformer with linear attention: LoFTR's coarse one, and the fine one of LoFTR and its
descendants.

Sources: Sun et al. 2021, section 3.2; Katharopoulos et al. 2020 (linear attention).
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.networks.grids import Perceptron
from mkpc_kaggle.matchers.networks.layers import Linear

Masks = tuple[Tensor, Tensor]


def linear_attention(
    q: Tensor, k: Tensor, v: Tensor, heads: int, masks: Masks | None = None
) -> Tensor:
    """Map queries (N, L, C), keys and values (N, S, C) to (N, L, C). Each head has consecutive
    channels.

    ``masks`` of queries (N, L) and of keys (N, S) are True at content. A masked query's output is zero, and a
    masked key has no effect. ``q`` and ``k`` are overwritten.
    """
    q, k = functional.elu(q, inplace=True).add_(1.0), functional.elu(k, inplace=True).add_(1.0)
    if masks is not None:
        q, k = q.mul_(masks[0][..., None]), k.mul_(masks[1][..., None])
    width = q.shape[2] // heads
    # (N, heads, L or S, D)
    q, k, v = (x.view(*x.shape[:2], heads, width).transpose(1, 2) for x in (q, k, v))
    total = q @ k.sum(dim=2)[..., None]  # (N, heads, L, 1)
    attended: Tensor = q @ (k.transpose(2, 3) @ v) / (total + 1e-6)  # (N, heads, L, D)
    return attended.transpose(1, 2).flatten(2)


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
            Linear(2 * width, 2 * width, bias=False), Linear(2 * width, width, bias=False)
        )
        self.norm1 = nn.LayerNorm(width)
        self.norm2 = nn.LayerNorm(width)

    def forward(self, x: Tensor, source: Tensor, masks: Masks | None = None) -> Tensor:
        """Map tokens (N, L, C) and source (N, S, C), with their masks (N, L) and (N, S), to (N, L,
        C).
        """
        # One cast instead of one per projection.
        seen = x.to(self.q_proj.weight.dtype)
        other = seen if source is x else source.to(seen.dtype)
        q, k, v = self.q_proj(seen).float(), self.k_proj(other).float(), self.v_proj(other).float()
        message = self.norm1(self.merge(linear_attention(q, k, v, self.heads, masks)))  # (N, L, C)
        both = torch.cat([seen, message.to(seen.dtype)], dim=2)
        update: Tensor = self.norm2(self.mlp(both).float())
        return update.add_(x)


class LinearTransformer(nn.Module):
    """``cycles`` of a self-attention and a cross-attention layer. Both images share each layer.

    Cross attention runs in sequence: image 1 is updated from the updated image 0.
    """

    def __init__(self, width: int, heads: int, cycles: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(EncoderLayer(width, heads) for _ in range(2 * cycles))

    def forward(self, x0: Tensor, x1: Tensor, masks: Masks | None = None) -> tuple[Tensor, Tensor]:
        """Map (N, L, C) and (N, S, C), with masks (N, L) and (N, S), True at content, to the same
        shapes.
        """
        own0 = own1 = cross0 = cross1 = None
        if masks is not None:
            mask0, mask1 = masks
            own0, own1, cross0, cross1 = (
                (mask0, mask0),
                (mask1, mask1),
                (mask0, mask1),
                (mask1, mask0),
            )
        for index, layer in enumerate(self.layers):
            if index % 2 == 0:
                x0, x1 = layer(x0, x0, own0), layer(x1, x1, own1)
            else:
                x0 = layer(x0, x1, cross0)
                x1 = layer(x1, x0, cross1)
        return x0, x1
