"""The pre-norm block of vision transformers (Dosovitskiy et al. 2021, section 3.1), for inference only.

Parameter names are those of DINOv2's checkpoints. Sums and norms are float32; what is added to the tokens is
computed in the precision of the linear layers' weights.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.networks.layers import Linear

EXPANSION = 4  # of the perceptron's hidden layer


class VitBlock(nn.Module):
    """Self-attention, then a perceptron, each on normed tokens and added to them.

    ``epsilon`` of the norms; ``scaled``: each addition has a factor of its own per channel.
    """

    def __init__(self, width: int, heads: int, epsilon: float, *, bias: bool, scaled: bool) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, epsilon)
        self.attn = VitAttention(width, heads, bias)
        self.ls1 = Scale(width) if scaled else nn.Identity()
        self.norm2 = nn.LayerNorm(width, epsilon)
        self.mlp = VitPerceptron(width)
        self.ls2 = Scale(width) if scaled else nn.Identity()

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, n, C) -> (B, n, C), float32."""
        tokens = tokens + self.ls1(self.attn(self.norm1(tokens)))
        return tokens.add_(self.ls2(self.mlp(self.norm2(tokens))))


class VitAttention(nn.Module):
    """Every token looks at all of them; ``bias`` of queries, keys and values."""

    def __init__(self, width: int, heads: int, bias: bool) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = Linear(width, 3 * width, bias)
        self.proj = Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, n, C) -> (B, n, C) in the weights' precision."""
        projected = self.qkv(tokens.to(self.qkv.weight.dtype))  # (B, n, 3 C): all queries, keys, then values
        split = projected.view(*projected.shape[:2], 3, self.heads, -1).permute(
            2, 0, 3, 1, 4
        )  # (3, B, heads, n, D)
        outputs = functional.scaled_dot_product_attention(*split.unbind())
        mixed: Tensor = self.proj(outputs.transpose(1, 2).flatten(2))
        return mixed


class VitPerceptron(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1 = Linear(width, EXPANSION * width)
        self.fc2 = Linear(EXPANSION * width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, n, C) -> (B, n, C) in the weights' precision."""
        out: Tensor = self.fc2(functional.gelu(self.fc1(tokens.to(self.fc1.weight.dtype))))
        return out


class Scale(nn.Module):
    """A factor per channel."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma
