"""Shared parts of keypoint matchers: keypoints of a picture, encoders, matches from indices."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from mkpc_kaggle.config import AT_LEAST_1, check_ranges
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import Picture, Placement
from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.layers import Assignment
from mkpc_kaggle.matchers.networks.placement import autocast

# Images (B, 3, H, W) -> for each image, points (K, 2) in pixels and unit descriptors (K, D).
Detector = Callable[[Tensor], Iterable[tuple[Tensor, Tensor]]]


@dataclass(frozen=True)
class KeypointOptions:
    """The options of all matchers of keypoints."""

    features: int = 2048  # the number of strongest keypoints per picture

    def __post_init__(self) -> None:
        check_ranges(self, features=AT_LEAST_1)


@dataclass(frozen=True, eq=False)
class Keypoints:
    """K keypoints of one picture.

    ``points`` (K, 2) are float32 in view pixels, ``descriptors`` (K, D) unit vectors. If the
    detector has them: ``scales`` (K,), diameters in view pixels, and ``orientations`` (K,),
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
        """Return the keypoints on the content, none on the padding.

        ``shapes``: scales and orientations, or nothing.
        """
        # Pixel centres are at integers, so the first pixel begins at -0.5.
        upper = points.new_tensor(content) - 0.5
        kept = ((points >= -0.5) & (points < upper)).all(dim=1)
        return cls(
            points[kept], descriptors[kept], content, *(shape[kept] for shape in shapes)
        )

    def __len__(self) -> int:
        return len(self.points)


Encode = Callable[[Sequence[Picture]], list[Keypoints]]


def keypoint_encoder(detect: Detector, placement: Placement) -> Encode:
    """Return an encoder that runs a detector on the placement's device."""

    @torch.inference_mode()
    def encode(pictures: Sequence[Picture]) -> list[Keypoints]:
        found = detect(image_batch(pictures, placement.device))
        # A library's network may return half precision.
        return [
            Keypoints.on_content(points.float(), descriptors.float(), picture.content)
            for (points, descriptors), picture in zip(found, pictures, strict=True)
        ]

    return encode


def library_encoder(
    name: str, network: nn.Module, features: nn.Module, detect: Detector, placement: Placement
) -> Encode:
    """Return the encoder of a library's detector, such as kornia's.

    ``detect`` runs the loaded ``network``, here in the placement's precision by autocast. Raises if
    the output of its module ``features`` is not finite: detectors drop NaN scores in silence.
    """
    network.eval().to(placement.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    features.register_forward_hook(
        lambda *call: check_finite(f"features of {name}", call[-1])
    )

    def detect_in_precision(images: Tensor) -> Iterable[tuple[Tensor, Tensor]]:
        with autocast(placement):
            return detect(images)

    return keypoint_encoder(detect_in_precision, placement)


def matches_of(points0: Tensor, points1: Tensor, found: Assignment) -> Matches:
    """Return the matches of two pictures' points (N, 2) and (M, 2) that an assignment pairs."""
    return Matches(
        points0[found.index0].cpu().numpy(),
        points1[found.index1].cpu().numpy(),
        found.scores.cpu().numpy(),
    )


def image_batch(pictures: Sequence[Picture], device: str) -> Tensor:
    """Convert pictures of one shape to float32 in [0, 1].

    Return (B, 3, H, W) for RGB, (B, 1, H, W) for gray.
    """
    stacked = np.stack([picture.pixels for picture in pictures])
    # As bytes, a quarter of the floats' traffic to a GPU.
    batch = torch.from_numpy(stacked).to(device)
    batch = batch[:, None] if stacked.ndim == 3 else batch.permute(0, 3, 1, 2)
    return batch.float() / 255
