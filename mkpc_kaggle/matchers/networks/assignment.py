"""Mutual matches of the keypoints of two images from a matrix of scores."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Assignment:
    """M matches by ascending ``index0``: keypoints ``index0``, ``index1`` (M,) int64, ``scores`` (M,) in 0..1."""

    index0: Tensor
    index1: Tensor
    scores: Tensor

    @classmethod
    def empty(cls, device: torch.device) -> "Assignment":
        index = torch.zeros(0, dtype=torch.int64, device=device)
        return cls(index, index, torch.zeros(0, device=device))


def mutual_matches(log_scores: Tensor, threshold: float) -> Assignment:
    """Pairs of keypoints that are each other's best in (N0, N1) logarithms, scored above the threshold."""
    (best0, partner0), partner1 = log_scores.max(dim=1), log_scores.argmax(dim=0)  # (N0,) twice, (N1,)
    index0, scores = torch.arange(len(partner0), device=log_scores.device), best0.exp()
    kept = (partner1[partner0] == index0) & (scores > threshold)
    return Assignment(index0[kept], partner0[kept], scores[kept])
