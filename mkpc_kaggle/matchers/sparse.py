"""Shared parts of keypoint matchers: keypoints of a picture, encoders, matches from pairs of
indices.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mkpc_kaggle.config import AT_LEAST_1, check_ranges
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import Picture, Placement

# Images (B, 3, H, W) -> for each image, points (K, 2) in pixels and unit descriptors (K, D).
Detector = Callable[[Tensor], Iterable[tuple[Tensor, Tensor]]]


@dataclass(frozen=True)
class KeypointOptions:
    features: int = 2048  # the number of strongest keypoints per picture

    def __post_init__(self) -> None:
        check_ranges(self, features=AT_LEAST_1)


@dataclass(frozen=True, eq=False)
class Keypoints:
    """K keypoints of one picture: ``points`` (K, 2) float32 in view pixels, unit ``descriptors``
    (K, D).

    If the detector has them: ``scales`` (K,), diameters in view pixels, and ``orientations`` (K,),
    radians.
    """

    points: Tensor
    descriptors: Tensor
    content: Size
    scales: Tensor | None = None
    orientations: Tensor | None = None

    @classmethod
    def on_content(
        cls, points: Tensor, descriptors: Tensor, content: Size, *shapes: Tensor
    ) -> "Keypoints":
        """Return the keypoints on the content, none on the padding; ``shapes``: scales and
        orientations.
        """
        upper = points.new_tensor(content) - 0.5
        kept = ((points >= -0.5) & (points < upper)).all(dim=1)
        return cls(points[kept], descriptors[kept], content, *(shape[kept] for shape in shapes))

    def __len__(self) -> int:
        return len(self.points)


Encode = Callable[[Sequence[Picture]], list[Keypoints]]


def keypoint_encoder(detect: Detector, placement: Placement) -> Encode:
    """Return an encoder that runs a detector on the placement's device."""

    @torch.inference_mode()
    def encode(pictures: Sequence[Picture]) -> list[Keypoints]:
        found = list(detect(image_batch(pictures, placement.device)))
        return [
            Keypoints.on_content(points.float(), descriptors.float(), picture.content)
            for (points, descriptors), picture in zip(found, pictures, strict=True)
        ]

    return encode


def matches_of(
    points0: Tensor, points1: Tensor, index0: Tensor, index1: Tensor, scores: Tensor
) -> Matches:
    """Return the matches that pair point ``index0[i]`` of one picture with ``index1[i]`` of the
    other.
    """
    return Matches(
        points0[index0].cpu().numpy(), points1[index1].cpu().numpy(), scores.cpu().numpy()
    )


def image_batch(pictures: Sequence[Picture], device: str) -> Tensor:
    """Convert pictures of one shape to float32 in [0, 1]: (B, 3, H, W) for RGB, (B, 1, H, W) for
    gray.
    """
    stacked = np.stack([picture.pixels for picture in pictures])
    batch = torch.from_numpy(stacked).to(device)
    batch = batch[:, None] if stacked.ndim == 3 else batch.permute(0, 3, 1, 2)
    return batch.float() / 255
