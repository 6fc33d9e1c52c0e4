"""SuperGlue, a matcher of two sets of keypoints (Sarlin et al. 2020, arXiv 1911.11763).

Parameter names match ``superglue_outdoor.pth`` and ``superglue_indoor.pth``; their terms
(noncommercial research) apply to every use. The keypoints of both images share one tensor (1, N,
256), N = N0 + N1: all layers act on rows, and only attention separates the images.
"""

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.grids import pointwise
from mkpc_kaggle.matchers.networks.layers import Assignment, attention, linear, mutual_matches
from mkpc_kaggle.matchers.networks.superpoint import SuperPointKeypoints

CHANNELS = 256
HEADS = 4
LAYERS = 18  # of the graph network: self, cross, self, cross, ...


class Pointwise(nn.Conv1d):
    """A linear map of channels, (..., in) to (..., out), with Conv1d's weight (out, in, 1)."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__(channels_in, channels_out, kernel_size=1)

    def forward(self, x: Tensor) -> Tensor:
        return pointwise(self, x)


def pointwise_network(*channels: int) -> nn.Sequential:
    """Make linear maps between these numbers of channels, with batch norms and ReLUs between.

    Inputs are (..., C). Fold the norms first: a batch norm would take another axis for the
    channels.
    """
    steps: list[nn.Module] = []
    for width_in, width_out in pairwise(channels[:-1]):
        steps.append(Pointwise(width_in, width_out))
        steps.append(nn.BatchNorm1d(width_out))
        steps.append(nn.ReLU(inplace=True))
    # Nothing follows the last map.
    return nn.Sequential(*steps, Pointwise(*channels[-2:]))


class SuperGlueAttention(nn.Module):
    """Attention with four heads; in the checkpoint, channel c belongs to head ``c mod 4``."""

    def __init__(self) -> None:
        super().__init__()
        # Query, key, value.
        self.proj = nn.ModuleList(Pointwise(CHANNELS, CHANNELS) for _ in range(3))
        self.merge = Pointwise(CHANNELS, CHANNELS)

    def forward(self, x: Tensor, n0: int, *, cross: bool) -> Tensor:
        """Return messages (1, N, 256) to the keypoints ``x`` (1, N, 256).

        The first ``n0`` keypoints belong to image 0. Messages come from keypoints of the same
        image, or with ``cross`` from keypoints of the other image.
        """
        # Reordering channels by head costs less in the weights than in all keypoints.
        maps = cast("Iterable[nn.Conv1d]", self.proj)
        weight = torch.cat([_by_head(each.weight[:, :, 0]) for each in maps])  # (768, 256)
        bias = torch.cat([_by_head(each.get_parameter("bias")) for each in maps])
        projected = linear(x, weight, bias)  # (1, N, 768)
        split = projected.view(*x.shape[:2], 3, HEADS, -1)
        heads = split.permute(2, 0, 3, 1, 4)  # (3, 1, 4, N, 64)
        query0, key0, value0 = heads[..., :n0, :]  # (1, 4, N0, 64) each
        query1, key1, value1 = heads[..., n0:, :]  # (1, 4, N1, 64) each
        if cross:
            key0, key1 = key1, key0
            value0, value1 = value1, value0
        precision = self.merge.weight.dtype
        output0 = attention(query0, key0, value0, precision)  # (1, 4, N0, 64)
        output1 = attention(query1, key1, value1, precision)  # (1, 4, N1, 64)
        by_keypoint = [output0.transpose(1, 2), output1.transpose(1, 2)]
        output = torch.cat(by_keypoint, dim=1).flatten(2)  # (1, N, 256)
        # The outputs are in order of the heads, so the columns of ``merge`` are ordered likewise.
        merge = _by_head(self.merge.weight[:, :, 0].T).T
        return linear(output, merge, self.merge.bias)


class SuperGlueLayer(nn.Module):
    """A layer of the graph network, which updates keypoints by messages from other keypoints."""

    def __init__(self, *, cross: bool) -> None:
        super().__init__()
        self.cross = cross
        self.attn = SuperGlueAttention()
        self.mlp = pointwise_network(2 * CHANNELS, 2 * CHANNELS, CHANNELS)

    def forward(self, x: Tensor, n0: int) -> Tensor:
        """Update the keypoints ``x`` (1, N, 256); the first ``n0`` belong to image 0."""
        message = self.attn(x, n0, cross=self.cross)
        change: Tensor = self.mlp(torch.cat([x, message], dim=2))
        return x + change


class SuperGlue(nn.Module):
    """Keypoint encoder, graph network, optimal transport; for inference only.

    Defaults are as in the published results. Scores of matches exceed ``match_threshold``.
    """

    def __init__(self, sinkhorn_iterations: int = 20, match_threshold: float = 0.2) -> None:
        super().__init__()
        self.sinkhorn_iterations = sinkhorn_iterations
        self.match_threshold = match_threshold
        self.kenc = nn.ModuleDict(
            {"encoder": pointwise_network(3, 32, 64, 128, 256, CHANNELS)}
        )
        layers = nn.ModuleList(
            SuperGlueLayer(cross=index % 2 == 1) for index in range(LAYERS)
        )
        self.gnn = nn.ModuleDict({"layers": layers})
        self.final_proj = Pointwise(CHANNELS, CHANNELS)
        self.bin_score = nn.Parameter(torch.tensor(1.0))  # the score of being unmatched
        self.eval().requires_grad_(False)

    def forward(self, image0: SuperPointKeypoints, image1: SuperPointKeypoints) -> Assignment:
        """Match the keypoints of both images; no matches if an image has no keypoints."""
        n0 = len(image0.points)
        if n0 == 0 or len(image1.points) == 0:
            return Assignment.empty(image0.points.device)
        x = torch.cat([self.encoded(image0), self.encoded(image1)], dim=1)
        for layer in self.gnn.get_submodule("layers").children():
            x = layer(x, n0)
        scores = self.score_matrix(self.final_proj(x), n0)
        check_finite("scores of superglue", scores)
        log_plan = log_optimal_transport(scores, self.bin_score, self.sinkhorn_iterations)
        # Without the dustbins, which take part through the transport only.
        return mutual_matches(log_plan[0, :-1, :-1], self.match_threshold)

    def encoded(self, image: SuperPointKeypoints) -> Tensor:
        """Return the graph network's input (1, N, 256): descriptors plus encoded keypoints."""
        points = normalise_points(image.points, image.size)
        scores = image.scores.float()[:, None]
        positions = torch.cat([points, scores], dim=1)  # (N, 3)
        encoded: Tensor = self.kenc["encoder"](positions[None])
        return encoded + image.descriptors[None].float()

    @staticmethod
    def score_matrix(projected: Tensor, n0: int) -> Tensor:
        """Return scaled products (1, N0, N1) float32 of projected features (1, N0 + N1, 256)."""
        first = projected[:, :n0].float()
        second = projected[:, n0:].float()
        return (first @ second.mT) / math.sqrt(CHANNELS)


def _by_head(rows: Tensor) -> Tensor:
    """Order the 256 rows of a vector or matrix by head; checkpoints interleave the heads."""
    interleaved = rows.reshape(CHANNELS // HEADS, HEADS, -1)
    return interleaved.transpose(0, 1).reshape(rows.shape)


def normalise_points(points: Tensor, size: Size) -> Tensor:
    """Return points from the image's middle, float32, in units of 0.7 times its longer side."""
    # As published, without half a pixel, and of the image that the detector saw.
    middle = torch.tensor([size.width / 2, size.height / 2], device=points.device)
    return (points.float() - middle) / (0.7 * max(size))


def log_optimal_transport(scores: Tensor, bin_score: Tensor, iterations: int) -> Tensor:
    """Return the logarithms of Sinkhorn's plan (B, m + 1, n + 1) float32 for scores (B, m, n).

    Dustbins are last. Each keypoint has mass 1. The other image's dustbin can take the mass of all
    keypoints. An iteration scales the rows to their masses, then the columns.

    Adding the potentials u and v to the scores keeps all values in float32's range.
    """
    batch, m, n = scores.shape
    # The last row and column, the corner included, have the dustbin's score.
    couplings = bin_score.float().expand(batch, m + 1, n + 1).clone()
    couplings[:, :m, :n] = scores
    # Logarithms of the masses: of a keypoint 0, of a dustbin that of all keypoints.
    rows = couplings.new_zeros(m + 1)
    columns = couplings.new_zeros(n + 1)
    rows[m] = math.log(n)
    columns[n] = math.log(m)
    v = torch.zeros_like(couplings[:, 0])
    for _ in range(iterations):
        u = rows - (couplings + v[:, None]).logsumexp(dim=2)  # (B, m + 1)
        v = columns - (couplings + u[:, :, None]).logsumexp(dim=1)  # (B, n + 1)
    return (couplings + u[:, :, None]).add_(v[:, None])
