"""LoMa's matcher (Nordström et al. 2026, arXiv 2604.04931): all layers of LightGlue (Lindenberger et al. 2023).

The keypoints of both images share one tensor (1, N, d), N = N0 + N1; only attention separates the images.
Parameter names match the public checkpoints. For inference only.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.layers import Assignment, Linear, attention, mutual_matches

HEAD = 64  # channels of an attention head
LAYERS = 9


class LomaKeypoints(NamedTuple):
    """N keypoints of one image, float32: ``points`` (N, 2), (x, y) in [-1, 1] from edge to edge of the image;
    ``descriptors`` (N, D), of any length.
    """

    points: Tensor
    descriptors: Tensor


class RotaryEmbedding(nn.Module):
    """Rotations of pairs of channels by angles that are linear in a keypoint's position."""

    def __init__(self) -> None:
        super().__init__()
        self.Wr = nn.Linear(2, HEAD // 2, bias=False)

    def forward(self, points: Tensor) -> Tensor:
        """Return exp(i angle), (1, 1, N, 32) complex64, for points (1, N, 2)."""
        angles = points @ self.Wr.weight.float().T
        return torch.polar(torch.ones_like(angles), angles)[:, None]


def apply_rotary(x: Tensor, rotation: Tensor) -> Tensor:
    """Rotate pairs of channels of ``x`` (1, heads, N, 64) by complex numbers (1, 1, N, 32)."""
    pairs = torch.view_as_complex(x.view(*x.shape[:3], -1, 2))
    return torch.view_as_real(pairs * rotation).flatten(3)


def update(width: int) -> nn.Sequential:
    """Make the layers that update a keypoint's features by a message."""
    return nn.Sequential(
        Linear(2 * width, 2 * width), nn.LayerNorm(2 * width), nn.GELU(), Linear(2 * width, width)
    )


class LomaSelfAttention(nn.Module):
    """Messages between the keypoints of one image. ``Wqkv`` outputs are ordered by head, channel, then q, k, v."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.Wqkv = Linear(width, 3 * width)
        self.out_proj = Linear(width, width)
        self.ffn = update(width)

    def forward(self, x: Tensor, n0: int, rotation: Tensor) -> Tensor:
        """Map (1, N, d) to (1, N, d); the first ``n0`` of the N keypoints belong to image 0."""
        projected = self.Wqkv(x).view(*x.shape[:2], -1, HEAD, 3).transpose(1, 2)  # (1, heads, N, 64, 3)
        q, k, v = (part.contiguous() for part in projected.unbind(4))
        q, k = apply_rotary(q, rotation), apply_rotary(k, rotation)
        precision = self.out_proj.weight.dtype
        images = slice(None, n0), slice(n0, None)
        outputs = [attention(q[:, :, of], k[:, :, of], v[:, :, of], precision) for of in images]
        return updated(x, outputs, self.out_proj, self.ffn)


class LomaCrossAttention(nn.Module):
    """Messages between the two images' keypoints. Both directions use the same input features."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.to_qk = Linear(width, width)
        self.to_v = Linear(width, width)
        self.to_out = Linear(width, width)
        self.ffn = update(width)

    def forward(self, x: Tensor, n0: int) -> Tensor:
        """Map (1, N, d) to (1, N, d); the first ``n0`` of the N keypoints belong to image 0."""
        qk, v = (layer(x).view(*x.shape[:2], -1, HEAD).transpose(1, 2) for layer in (self.to_qk, self.to_v))
        (qk0, qk1), (v0, v1) = ((part[:, :, :n0], part[:, :, n0:]) for part in (qk, v))
        precision = self.to_out.weight.dtype
        outputs = [attention(qk0, qk1, v1, precision), attention(qk1, qk0, v0, precision)]
        return updated(x, outputs, self.to_out, self.ffn)


def updated(x: Tensor, outputs: list[Tensor], out: Linear, ffn: nn.Sequential) -> Tensor:
    """Update features (1, N, d) by the attention outputs (1, heads, Ni, 64) of both images."""
    output = torch.cat([each.transpose(1, 2) for each in outputs], dim=1).flatten(2)  # (1, N, d)
    change: Tensor = ffn(torch.cat([x, out(output)], dim=2))
    return x + change


class LomaLayer(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.self_attn = LomaSelfAttention(width)
        self.cross_attn = LomaCrossAttention(width)

    def forward(self, x: Tensor, n0: int, rotation: Tensor) -> Tensor:
        x = self.self_attn(x, n0, rotation)
        return self.cross_attn(x, n0)  # type: ignore[no-any-return]  # nn.Module's call is untyped


class LomaMatcher(nn.Module):
    """A matcher with ``descriptor`` input channels and ``width`` inner channels. Of a checkpoint's assignment
    layers, it uses only the last.
    """

    def __init__(self, descriptor: int, width: int) -> None:
        super().__init__()
        self.input_proj = nn.Identity() if descriptor == width else Linear(descriptor, width)
        self.posenc = RotaryEmbedding()
        self.transformers = nn.ModuleList(LomaLayer(width) for _ in range(LAYERS))
        self.log_assignment = nn.ModuleDict({str(LAYERS - 1): nn.ModuleDict({"final_proj": Linear(width, width)})})
        self.eval().requires_grad_(False)

    def forward(self, image0: LomaKeypoints, image1: LomaKeypoints, threshold: float) -> Assignment:
        """Return mutual matches scored above the threshold; none if an image has no keypoints."""
        n0, n1 = len(image0.points), len(image1.points)
        if n0 == 0 or n1 == 0:
            return Assignment.empty(image0.points.device)
        similarity = self.similarity(self.features(image0, image1), n0)
        check_finite("scores of loma", similarity)
        return mutual_matches(log_scores(similarity)[0], threshold)

    def features(self, image0: LomaKeypoints, image1: LomaKeypoints) -> Tensor:
        """Return (1, N0 + N1, d) after all layers."""
        rotation = self.posenc(torch.cat([image0.points, image1.points])[None])
        x: Tensor = self.input_proj(torch.cat([image0.descriptors, image1.descriptors])[None])
        for layer in self.transformers:
            x = layer(x, len(image0.points), rotation)
        return x

    def similarity(self, features: Tensor, n0: int) -> Tensor:
        """Return the similarities (1, N0, N1) of both images' keypoints."""
        projected = self.log_assignment.get_submodule(f"{LAYERS - 1}.final_proj")(features)
        scaled = projected / features.shape[2] ** 0.25
        similarity: Tensor = scaled[:, :n0] @ scaled[:, n0:].mT
        return similarity


def log_scores(similarity: Tensor) -> Tensor:
    """Return the logarithm (1, N0, N1) of the product of two softmaxes, one over each image's keypoints."""
    return similarity.log_softmax(dim=1).add_(similarity.log_softmax(dim=2))
