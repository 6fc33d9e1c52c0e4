"""Mutual matches of the keypoints of two images from a matrix of scores."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Assignment:
    """``matches0`` (B, N0) int64: each keypoint's match in image 1, or -1; ``matches1`` (B, N1) the inverse.

    ``scores0`` (B, N0) and ``scores1`` (B, N1) float32: in 0..1 the score of every mutual nearest pair,
    also of those below the threshold; 0 for other keypoints.
    """

    matches0: Tensor
    matches1: Tensor
    scores0: Tensor
    scores1: Tensor


def mutual_matches(log_scores: Tensor, threshold: float) -> Assignment:
    """Pairs of keypoints that are each other's best in (B, N0, N1) logarithms, scored above the threshold."""
    (best0, partner0), partner1 = log_scores.max(dim=2), log_scores.argmax(dim=1)  # (B, N0) twice, (B, N1)
    mutual0 = partner1.gather(1, partner0) == torch.arange(log_scores.shape[1], device=log_scores.device)
    mutual1 = partner0.gather(1, partner1) == torch.arange(log_scores.shape[2], device=log_scores.device)
    scores0 = best0.exp().where(mutual0, 0)
    scores1 = scores0.gather(1, partner1).where(mutual1, 0)
    matches0 = partner0.where(mutual0 & (scores0 > threshold), -1)
    matches1 = partner1.where(mutual1 & (scores1 > threshold), -1)
    return Assignment(matches0, matches1, scores0, scores1)


def no_assignment(scores0: Tensor, scores1: Tensor) -> Assignment:
    """No matches between images of which at least one has no keypoints; takes shapes and device from (B, Ni)."""
    matches0, matches1 = (torch.full_like(scores, -1, dtype=torch.int64) for scores in (scores0, scores1))
    return Assignment(matches0, matches1, torch.zeros_like(scores0).float(), torch.zeros_like(scores1).float())
