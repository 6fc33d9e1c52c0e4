"""LoMa's matcher (Nordström et al. 2026, arXiv 2604.04931): LightGlue (Lindenberger et al. 2023), all layers.

Inside, the keypoints of both images stand in one tensor (B, N0 + N1, d): only attention tells the images apart.
Parameter names are those of the public checkpoints. For inference only.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.networks.assignment import Assignment, mutual_matches, no_assignment
from mkpc_kaggle.matchers.networks.layers import Linear, attention
from mkpc_kaggle.matchers.numbers import check_finite

HEAD = 64
"""Channels of an attention head."""

LAYERS = 9


@dataclass(frozen=True, eq=False)
class LomaKeypoints:
    """N keypoints of one image in each of B pairs, float32: ``points`` (B, N, 2), (x, y) in [-1, 1] from edge to
    edge of the image; ``descriptors`` (B, N, D), of any length.
    """

    points: Tensor
    descriptors: Tensor


class Rotation(nn.Module):
    """Turns neighbouring channels by angles that depend linearly on where a keypoint lies."""

    def __init__(self) -> None:
        super().__init__()
        self.Wr = nn.Linear(2, HEAD // 2, bias=False)

    def forward(self, points: Tensor) -> Tensor:
        """exp(i angle), (B, 1, N, 32) complex64, for points (B, N, 2)."""
        angles = points @ self.Wr.weight.float().T
        return torch.polar(torch.ones_like(angles), angles)[:, None]


def turned(x: Tensor, rotation: Tensor) -> Tensor:
    """(B, heads, N, 64), channels in pairs, by (B, 1, N, 32)."""
    pairs = torch.view_as_complex(x.view(*x.shape[:3], -1, 2))
    return torch.view_as_real(pairs * rotation).flatten(3)


class Update(nn.Sequential):
    """The update of a keypoint's features by a message."""

    def __init__(self, width: int) -> None:
        super().__init__(
            Linear(2 * width, 2 * width), nn.LayerNorm(2 * width), nn.GELU(), Linear(2 * width, width)
        )


class SelfAttention(nn.Module):
    """Messages between the keypoints of one image. ``Wqkv`` orders its outputs by head, channel, then q, k, v."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.Wqkv = Linear(width, 3 * width)
        self.out_proj = Linear(width, width)
        self.ffn = Update(width)

    def forward(self, x: Tensor, n0: int, rotation: Tensor) -> Tensor:
        """(B, N, d) -> (B, N, d); the first ``n0`` of the N keypoints are image 0's."""
        projected = self.Wqkv(x).view(*x.shape[:2], -1, HEAD, 3).transpose(1, 2)  # (B, heads, N, 64, 3)
        q, k, v = (part.contiguous() for part in projected.unbind(4))
        q, k = turned(q, rotation), turned(k, rotation)
        precision = self.out_proj.weight.dtype
        images = slice(None, n0), slice(n0, None)
        outputs = [attention(q[:, :, of], k[:, :, of], v[:, :, of], precision) for of in images]
        return updated(x, outputs, self.out_proj, self.ffn)


class CrossAttention(nn.Module):
    """Messages from the keypoints of the other image, both ways from the features before it."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.to_qk = Linear(width, width)
        self.to_v = Linear(width, width)
        self.to_out = Linear(width, width)
        self.ffn = Update(width)

    def forward(self, x: Tensor, n0: int) -> Tensor:
        """As :class:`SelfAttention`'s."""
        qk, v = (layer(x).view(*x.shape[:2], -1, HEAD).transpose(1, 2) for layer in (self.to_qk, self.to_v))
        (qk0, qk1), (v0, v1) = ((part[:, :, :n0], part[:, :, n0:]) for part in (qk, v))
        precision = self.to_out.weight.dtype
        outputs = [attention(qk0, qk1, v1, precision), attention(qk1, qk0, v0, precision)]
        return updated(x, outputs, self.to_out, self.ffn)


def updated(x: Tensor, outputs: list[Tensor], out: Linear, ffn: Update) -> Tensor:
    """Features (B, N, d) updated by the attention outputs (B, heads, Ni, 64) of both images."""
    output = torch.cat([one.transpose(1, 2) for one in outputs], dim=1).flatten(2)  # (B, N, d)
    change: Tensor = ffn(torch.cat([x, out(output)], dim=2))
    return x + change


class Layer(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.self_attn = SelfAttention(width)
        self.cross_attn = CrossAttention(width)

    def forward(self, x: Tensor, n0: int, rotation: Tensor) -> Tensor:
        x = self.self_attn(x, n0, rotation)
        return self.cross_attn(x, n0)  # type: ignore[no-any-return]  # nn.Module's call is untyped


class LomaMatcher(nn.Module):
    """``descriptor`` channels come in, ``width`` are worked with. Of a checkpoint's assignments only the last
    layer's is used.
    """

    def __init__(self, descriptor: int, width: int) -> None:
        super().__init__()
        self.input_proj = nn.Identity() if descriptor == width else Linear(descriptor, width)
        self.posenc = Rotation()
        self.transformers = nn.ModuleList(Layer(width) for _ in range(LAYERS))
        self.log_assignment = nn.ModuleDict({str(LAYERS - 1): nn.ModuleDict({"final_proj": Linear(width, width)})})
        self.eval().requires_grad_(False)

    def forward(self, image0: LomaKeypoints, image1: LomaKeypoints, threshold: float) -> Assignment:
        """Mutual matches scored above the threshold in each of B pairs; no keypoints give no matches."""
        n0, n1 = image0.points.shape[1], image1.points.shape[1]
        if n0 == 0 or n1 == 0:
            return no_assignment(image0.points[..., 0], image1.points[..., 0])
        similarity = self.similarity(self.features(image0, image1), n0)
        check_finite("scores of loma", similarity)
        return mutual_matches(log_scores(similarity), threshold)

    def features(self, image0: LomaKeypoints, image1: LomaKeypoints) -> Tensor:
        """(B, N0 + N1, d) after all layers."""
        n0 = image0.points.shape[1]
        rotation = self.posenc(torch.cat([image0.points, image1.points], dim=1))
        x: Tensor = self.input_proj(torch.cat([image0.descriptors, image1.descriptors], dim=1))
        for layer in self.transformers:
            x = layer(x, n0, rotation)
        return x

    def similarity(self, features: Tensor, n0: int) -> Tensor:
        """(B, N0, N1)."""
        projected = self.log_assignment.get_submodule(f"{LAYERS - 1}.final_proj")(features)
        scaled = projected / features.shape[2] ** 0.25
        similarity: Tensor = scaled[:, :n0] @ scaled[:, n0:].mT
        return similarity


def log_scores(similarity: Tensor) -> Tensor:
    """Logarithm of the product of the softmax over either image's keypoints, (B, N0, N1)."""
    return similarity.log_softmax(dim=1).add_(similarity.log_softmax(dim=2))
