"""LightGlue, a matcher of two sets of keypoints.

Source: Lindenberger, Sarlin, Pollefeys, "LightGlue: Local Feature Matching at Light Speed", ICCV
2023.

The keypoints of both images share one tensor (1, N, d), N = N0 + N1; only attention separates the
images. Parameter names match the public checkpoints. For inference only.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.layers import (
    Assignment,
    ExactLinear,
    Linear,
    attention,
    mutual_matches,
)

# Pruning copies the features of the kept keypoints. A GPU gains only with more keypoints than this.
MIN_PRUNED_KEYPOINTS = {"cpu": 0, "cuda": 1024}


@dataclass(frozen=True)
class LightGlueShape:
    """Sizes of a published LightGlue.

    ``descriptor`` and ``width``: channels of descriptors and inside the layers. ``positions``:
    values per keypoint, x and y, or x, y, scale and orientation.
    """

    descriptor: int
    width: int = 256
    heads: int = 4
    layers: int = 9
    positions: int = 2


class RotaryEmbedding(nn.Module):
    """Rotations of pairs of channels by angles that are linear in a keypoint's position."""

    def __init__(self, positions: int, head: int) -> None:
        super().__init__()
        # Float32 in any precision: bfloat16 would round positions to 8 bits.
        self.Wr = ExactLinear(positions, head // 2, bias=False)

    def forward(self, positions: Tensor) -> Tensor:
        """Return exp(i angle), (1, 1, N, head / 2) complex64, for positions (1, N, 2 or 4)."""
        angles = positions @ self.Wr.weight.T
        return torch.polar(torch.ones_like(angles), angles)[:, None]


def apply_rotary(x: Tensor, rotation: Tensor) -> Tensor:
    """Rotate channel pairs of ``x`` (1, heads, N, head) by complex numbers (1, 1, N, head / 2)."""
    # Channels 2 i and 2 i + 1 are the real and imaginary part: a rotation is one product.
    pairs = torch.view_as_complex(x.view(*x.shape[:3], -1, 2))
    return torch.view_as_real(pairs * rotation).flatten(3)


def update(width: int) -> nn.Sequential:
    """Make the layers that update a keypoint's features by a message."""
    return nn.Sequential(
        Linear(2 * width, 2 * width),
        nn.LayerNorm(2 * width),
        nn.GELU(),
        Linear(2 * width, width),
    )


class SelfAttention(nn.Module):
    """Messages between the keypoints of one image.

    The outputs of ``Wqkv`` are ordered by head, then by channel, then q, k, v.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.Wqkv = Linear(width, 3 * width)
        self.out_proj = Linear(width, width)
        self.ffn = update(width)

    def forward(self, x: Tensor, n0: int, rotation: Tensor) -> Tensor:
        """Map (1, N, d) to (1, N, d); the first ``n0`` of the N keypoints belong to image 0."""
        projected = self.Wqkv(x).view(*x.shape[:2], self.heads, -1, 3)
        by_head = projected.transpose(1, 2)  # (1, heads, N, head, 3)
        # Contiguous: a view as complex numbers needs adjacent pairs of channels.
        q, k, v = (part.contiguous() for part in by_head.unbind(4))
        # Values are not rotated: only the attention depends on positions.
        q = apply_rotary(q, rotation)
        k = apply_rotary(k, rotation)
        precision = self.out_proj.weight.dtype
        outputs = []
        for image in (slice(None, n0), slice(n0, None)):
            own_q = q[:, :, image]
            own_k = k[:, :, image]
            own_v = v[:, :, image]
            outputs.append(attention(own_q, own_k, own_v, precision))
        return updated(x, outputs, self.out_proj, self.ffn)


class CrossAttention(nn.Module):
    """Messages between the two images' keypoints. Both directions use the same input features."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.to_qk = Linear(width, width)
        self.to_v = Linear(width, width)
        self.to_out = Linear(width, width)
        self.ffn = update(width)

    def forward(self, x: Tensor, n0: int) -> Tensor:
        """Map (1, N, d) to (1, N, d); the first ``n0`` of the N keypoints belong to image 0."""
        # One projection is both query and key, so similarities are the same in both directions.
        by_head = (*x.shape[:2], self.heads, -1)
        qk = self.to_qk(x).view(by_head).transpose(1, 2)  # (1, heads, N, head)
        v = self.to_v(x).view(by_head).transpose(1, 2)
        qk0 = qk[:, :, :n0]
        qk1 = qk[:, :, n0:]
        v0 = v[:, :, :n0]
        v1 = v[:, :, n0:]
        precision = self.to_out.weight.dtype
        # Two products with a fused softmax are faster than one product whose result both directions
        # read.
        message0 = attention(qk0, qk1, v1, precision)
        message1 = attention(qk1, qk0, v0, precision)
        return updated(x, [message0, message1], self.to_out, self.ffn)


def updated(x: Tensor, outputs: list[Tensor], out: Linear, ffn: nn.Sequential) -> Tensor:
    """Update features (1, N, d) by the attention outputs (1, heads, Ni, head) of both images."""
    by_keypoint = [each.transpose(1, 2) for each in outputs]  # (1, Ni, heads, head)
    output = torch.cat(by_keypoint, dim=1).flatten(2)  # (1, N, d)
    change: Tensor = ffn(torch.cat([x, out(output)], dim=2))
    return x + change


class TransformerLayer(nn.Module):
    """Messages within each image, then between the images."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.self_attn = SelfAttention(width, heads)
        self.cross_attn = CrossAttention(width, heads)

    def forward(self, x: Tensor, n0: int, rotation: Tensor) -> Tensor:
        """Map (1, N, d) to (1, N, d); ``rotation`` is :class:`RotaryEmbedding`'s."""
        x = self.self_attn(x, n0, rotation)
        return self.cross_attn(x, n0)  # type: ignore[no-any-return]  # nn.Module's call is untyped


class MatchAssignment(nn.Module):
    """Similarities of keypoints, and each keypoint's probability to have a match at all."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.final_proj = ExactLinear(width, width)
        self.matchability = ExactLinear(width, 1)

    def forward(self, x: Tensor, n0: int) -> Tensor:
        """Return the logarithms (N0, N1) of match probabilities, from features (1, N, d)."""
        # Both factors of a product are divided by d^(1/4), the product by sqrt(d).
        scaled = self.final_proj(x)[0] / x.shape[2] ** 0.25  # (N, d)
        similarity = scaled[:n0] @ scaled[n0:].T  # (N0, N1)
        certainty = functional.logsigmoid(self.matchability(x)[0, :, 0])  # (N,)
        # Section 3.2 of the paper, in logarithms: dual softmax times both matchabilities.
        scores = log_scores(similarity)
        return scores + certainty[:n0, None] + certainty[n0:]

    def match_probability(self, x: Tensor) -> Tensor:
        """Map (1, N, d) to (N,) in 0..1."""
        logits: Tensor = self.matchability(x)
        return logits[0, :, 0].sigmoid()


class LightGlue(nn.Module):
    """LightGlue of any published shape, with early stopping and pruning (section 3.3 of the paper).

    Stop after a layer if more than the share ``depth`` of keypoints is confident. Drop confident
    keypoints that match with a probability of at most 1 - ``width``. Negative, or without
    ``adapts``: never; some checkpoints have only the last layer's assignment and no confidences.
    Matches score above ``threshold``.
    """

    def __init__(
        self,
        shape: LightGlueShape,
        depth: float = 0.95,
        width: float = 0.99,
        threshold: float = 0.1,
        *,
        adapts: bool = True,
    ) -> None:
        super().__init__()
        channels = shape.width
        heads = shape.heads
        layers = shape.layers
        self.depth = depth
        self.width = width
        self.threshold = threshold
        self.adapts = adapts and max(depth, width) > 0
        is_identity = shape.descriptor == channels
        self.input_proj = nn.Identity() if is_identity else Linear(shape.descriptor, channels)
        self.posenc = RotaryEmbedding(shape.positions, channels // heads)
        self.transformers = nn.ModuleList(
            TransformerLayer(channels, heads) for _ in range(layers)
        )
        # A run that stops early needs the assignment of the layer at which it stops; pruning needs
        # each layer's matchability.
        assignments = range(layers) if self.adapts else [layers - 1]
        self.log_assignment = nn.ModuleDict(
            {str(i): MatchAssignment(channels) for i in assignments}
        )
        # After the last layer nothing is decided, so it has no confidence.
        self.token_confidence = nn.ModuleList()
        for _ in range(layers - 1 if self.adapts else 0):
            confidence = nn.Sequential(ExactLinear(channels, 1))
            self.token_confidence.append(nn.ModuleDict({"token": confidence}))
        self.eval().requires_grad_(False)

    def forward(
        self,
        positions0: Tensor,
        descriptors0: Tensor,
        positions1: Tensor,
        descriptors1: Tensor,
    ) -> Assignment:
        """Return mutual matches that score above the threshold, by ascending ``index0``.

        Positions (Ni, 2 or 4) float32: see :func:`normalised`. Descriptors (Ni, D), unit vectors.
        """
        n0 = len(positions0)
        if n0 == 0 or len(positions1) == 0:
            return Assignment.empty(positions0.device)
        rotation = self.posenc(torch.cat([positions0, positions1])[None])
        x: Tensor = self.input_proj(torch.cat([descriptors0, descriptors1])[None])
        # The numbers of the remaining keypoints, in the order of both images.
        index = torch.arange(x.shape[1], device=x.device)
        total = x.shape[1]
        split = n0  # before pruning: the number of image 1's first keypoint
        last = len(self.transformers) - 1
        for layer, transformer in enumerate(self.transformers):
            x = transformer(x, n0, rotation)
            if layer == last or not self.adapts:
                continue
            confidence = self._confidence(x, layer)
            if self._may_stop(confidence, layer, total):
                last = layer
                break
            kept = self._kept(x, n0, confidence, layer)
            if kept is not None:
                x = x[:, kept]
                rotation = rotation[:, :, kept]
                index = index[kept]
                n0 = int((kept < n0).sum())
                if n0 == 0 or n0 == len(index):
                    return Assignment.empty(x.device)
        scores = self.assignment(last)(x, n0)
        check_finite("scores of lightglue", scores)
        found = mutual_matches(scores, self.threshold)
        # Pruning keeps the order, so matches stay ascending in ``index0``.
        index0 = index[:n0]
        index1 = index[n0:] - split
        return Assignment(index0[found.index0], index1[found.index1], found.scores)

    def assignment(self, layer: int) -> MatchAssignment:
        module = self.log_assignment[str(layer)]
        assert isinstance(module, MatchAssignment)
        return module

    def _confidence(self, x: Tensor, layer: int) -> Tensor | None:
        """Return how sure each keypoint is of its match, or of having none: (N,) in 0..1."""
        if self.depth <= 0:
            return None
        token = self.token_confidence[layer].get_submodule("token")
        confidence: Tensor = token(x)[0, :, 0].sigmoid()
        return confidence

    def _may_stop(self, confidence: Tensor | None, layer: int, total: int) -> bool:
        """Return whether enough of all ``total`` keypoints are confident; dropped ones were."""
        if confidence is None:
            return False
        unsure = int((confidence < self._threshold(layer)).sum())
        return 1 - unsure / total > self.depth

    def _kept(
        self, x: Tensor, n0: int, confidence: Tensor | None, layer: int
    ) -> Tensor | None:
        """Return the indices of the keypoints to keep, or ``None`` if no image is pruned."""
        fewest = MIN_PRUNED_KEYPOINTS.get(x.device.type, 0)
        prunes0 = n0 > fewest
        prunes1 = x.shape[1] - n0 > fewest
        if self.width <= 0 or not (prunes0 or prunes1):
            return None
        kept = self.assignment(layer).match_probability(x) > 1 - self.width
        # A keypoint that is still unsure may become a match in a later layer.
        if confidence is not None:
            kept |= confidence <= self._threshold(layer)
        if not prunes0:
            kept[:n0] = True
        if not prunes1:
            kept[n0:] = True
        return kept.nonzero()[:, 0]

    def _threshold(self, layer: int) -> float:
        """Return the least confidence of a sure keypoint, as published: lower in later layers."""
        return 0.8 + 0.1 * math.exp(-4.0 * layer / len(self.transformers))


def log_scores(similarity: Tensor) -> Tensor:
    """Return the logarithm (..., N0, N1) of the dual softmax: one over each image's keypoints."""
    return similarity.log_softmax(dim=-2).add_(similarity.log_softmax(dim=-1))


def normalised(points: Tensor, width: float, height: float) -> Tensor:
    """Map points (N, 2) in pixels of an image to [-1, 1] along its longer side, the centre to 0."""
    size = points.new_tensor([width, height])
    return (points - size / 2) / (size.max() / 2)
