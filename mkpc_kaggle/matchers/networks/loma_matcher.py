"""LoMa's matcher, LightGlue's layers without early stopping, pruning and matchability.

Source: Nordström et al. 2026, arXiv 2604.04931; Lindenberger et al. 2023 (LightGlue). The keypoints
of both images share one tensor (1, N, d), N = N0 + N1; only attention separates the images.
Parameter names match the public checkpoints. For inference only.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.layers import Assignment, Linear, mutual_matches
from mkpc_kaggle.matchers.networks.lightglue import (
    RotaryEmbedding,
    TransformerLayer,
    log_scores,
)

HEAD = 64  # channels of an attention head
LAYERS = 9


class LomaKeypoints(NamedTuple):
    """N keypoints of one image, float32.

    ``points`` (N, 2): (x, y) in [-1, 1] from edge to edge of the image. ``descriptors`` (N, D): of
    any length.
    """

    points: Tensor
    descriptors: Tensor


class LomaMatcher(nn.Module):
    """A matcher with ``descriptor`` input channels and ``width`` inner channels.

    Of a checkpoint's assignment layers, it uses only the last.
    """

    def __init__(self, descriptor: int, width: int) -> None:
        super().__init__()
        self.input_proj = nn.Identity() if descriptor == width else Linear(descriptor, width)
        self.posenc = RotaryEmbedding(2, HEAD)
        self.transformers = nn.ModuleList(
            TransformerLayer(width, width // HEAD) for _ in range(LAYERS)
        )
        # Names of the checkpoint: the assignment after the last layer.
        assignment = nn.ModuleDict({"final_proj": Linear(width, width)})
        self.log_assignment = nn.ModuleDict({str(LAYERS - 1): assignment})
        self.eval().requires_grad_(False)

    def forward(
        self, image0: LomaKeypoints, image1: LomaKeypoints, threshold: float
    ) -> Assignment:
        """Return mutual matches scored above the threshold; none if an image has no keypoints."""
        n0 = len(image0.points)
        if n0 == 0 or len(image1.points) == 0:
            return Assignment.empty(image0.points.device)
        similarity = self.similarity(self.features(image0, image1), n0)
        check_finite("scores of loma", similarity)
        # Matchability was an aid in training: unlike LightGlue's, it takes no part in scores.
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
        projection = self.log_assignment.get_submodule(f"{LAYERS - 1}.final_proj")
        # Both factors of a product are divided by d^(1/4), the product by sqrt(d).
        scaled = projection(features) / features.shape[2] ** 0.25
        similarity: Tensor = scaled[:, :n0] @ scaled[:, n0:].mT
        return similarity
