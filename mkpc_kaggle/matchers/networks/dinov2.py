"""DINOv2's vision transformer, without register tokens.

Source: Oquab et al., "DINOv2: Learning Robust Visual Features without Supervision", 2023.
Parameter names match the public checkpoints. For inference only.
"""

from math import isqrt

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.networks.grids import as_grid, as_map
from mkpc_kaggle.matchers.networks.layers import Linear

# Of ViT-L/14.
WIDTH = 1024
BLOCKS = 24
HEADS = 16
POSITIONS = 37  # the side of the stored grid of positional embeddings, in patches
PATCH = 14  # pixels a side: the stride of the features
EPSILON = 1e-6  # of the norms; PyTorch's default of 1e-5 changes the features
EXPANSION = 4  # of a perceptron's hidden layer
OFFSET = 0.1  # added to a grid's sides when positions are resampled, as in training


class DinoV2(nn.Module):
    """DINOv2's features, one vector per patch of 14 x 14 pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, WIDTH))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + POSITIONS**2, WIDTH))
        # For training only; it exists because checkpoints have it.
        self.mask_token = nn.Parameter(torch.zeros(1, WIDTH))
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, WIDTH, PATCH, PATCH)})
        blocks = (
            VitBlock(WIDTH, HEADS, EPSILON, bias=True, scaled=True) for _ in range(BLOCKS)
        )
        self.blocks = nn.ModuleList(blocks)
        self.norm = nn.LayerNorm(WIDTH, EPSILON)
        self.eval().requires_grad_(False)

    def forward(self, image: Tensor) -> Tensor:
        """Map normalised images (B, 3, 14 h, 14 w) to (B, C, h, w) float32, channels last."""
        embed = self.patch_embed["proj"]
        precision = self.patch_embed.get_parameter("proj.weight").dtype
        patches = as_grid(embed(image.to(precision)).float())  # (B, h, w, C)
        classes = self.cls_token.expand(len(image), -1, -1)
        tokens = torch.cat([classes, patches.flatten(1, 2)], dim=1)  # (B, 1 + h w, C)
        tokens.add_(self.positions(*patches.shape[1:3]))
        for block in self.blocks:
            tokens = block(tokens)
        normed: Tensor = self.norm(tokens)
        # The class token describes the whole image; matching needs the patches only.
        return as_map(normed[:, 1:].reshape(patches.shape))

    def positions(self, height: int, width: int) -> Tensor:
        """Return positional embeddings (1, 1 + h w, C) of the class token and a grid of patches.

        The stored grid is resampled by factors slightly above the ratios of the sides, as in
        training.
        """
        side = isqrt(
            self.pos_embed.shape[1]
        )  # the class token's adds less than one to the root
        if (height, width) == (side, side):
            return self.pos_embed
        stored = as_map(
            self.pos_embed[:, 1:].reshape(1, side, side, -1)
        )  # (1, C, side, side)
        factor_y = (height + OFFSET) / side
        factor_x = (width + OFFSET) / side
        # Not by ``size``: PyTorch samples at positions that follow from the given factors.
        resampled = functional.interpolate(
            stored, scale_factor=(factor_y, factor_x), mode="bicubic", align_corners=False
        )
        assert resampled.shape[2:] == (height, width)
        patches = as_grid(resampled).flatten(1, 2)  # (1, h w, C)
        return torch.cat([self.pos_embed[:, :1], patches], dim=1)


class VitBlock(nn.Module):
    """Self-attention, then a perceptron, each with a norm before it and a residual.

    Source: Dosovitskiy et al. 2021, section 3.1. Sums and norms are float32; the added terms are
    computed in the precision of the layers' weights. The norms use ``epsilon``. If ``scaled``, each
    added term has a learned factor per channel.
    """

    def __init__(
        self, width: int, heads: int, epsilon: float, *, bias: bool, scaled: bool
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, epsilon)
        self.attn = VitAttention(width, heads, bias)
        self.ls1 = Scale(width) if scaled else nn.Identity()
        self.norm2 = nn.LayerNorm(width, epsilon)
        self.mlp = VitPerceptron(width)
        self.ls2 = Scale(width) if scaled else nn.Identity()

    def forward(self, tokens: Tensor) -> Tensor:
        """Map (B, n, C) to (B, n, C), float32."""
        # The first sum is a copy: the caller's tokens are kept.
        tokens = tokens + self.ls1(self.attn(self.norm1(tokens)))
        return tokens.add_(self.ls2(self.mlp(self.norm2(tokens))))


class VitAttention(nn.Module):
    """Self-attention of all tokens; ``bias`` of the projection to queries, keys and values."""

    def __init__(self, width: int, heads: int, bias: bool) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = Linear(width, 3 * width, bias)
        self.proj = Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Map (B, n, C) to (B, n, C) in the weights' precision."""
        projected = self.qkv(tokens.to(self.qkv.weight.dtype))  # (B, n, 3 C)
        # Queries, then keys, then values; each head by head.
        split = projected.view(*projected.shape[:2], 3, self.heads, -1)
        q, k, v = split.permute(2, 0, 3, 1, 4)  # (B, heads, n, D) each
        outputs = functional.scaled_dot_product_attention(q, k, v)
        mixed: Tensor = self.proj(outputs.transpose(1, 2).flatten(2))
        return mixed


class VitPerceptron(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1 = Linear(width, EXPANSION * width)
        self.fc2 = Linear(EXPANSION * width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Map (B, n, C) to (B, n, C) in the weights' precision."""
        hidden = self.fc1(tokens.to(self.fc1.weight.dtype))
        out: Tensor = self.fc2(
            functional.gelu(hidden)
        )  # the exact GELU, not the one with tanh
        return out


class Scale(nn.Module):
    """A factor per channel (Touvron et al. 2021, "LayerScale")."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma
