"""Matched keypoints moved by fractions of a pixel, by Keypt2Subpx."""

from dataclasses import dataclass

import torch
from kornia.color import rgb_to_grayscale
from torch import Tensor

from mkpc_kaggle.matchers.contract import MatcherSpec, Placement, Refine
from mkpc_kaggle.matchers.networks.keypt2subpx import Keypt2Subpx, patches_at
from mkpc_kaggle.matchers.sparse import Keypoints
from mkpc_kaggle.weights import WeightStore, load_into


@dataclass(frozen=True, eq=False)
class Refiner:
    """Its network stays float32: it decides on hundredths of a pixel, and costs little."""

    network: Keypt2Subpx

    def patches(self, image: Tensor, points: Tensor) -> Tensor:
        """What the network sees of ``points`` (K, 2) of an ``image`` (3, H, W), RGB in [0, 1]."""
        return patches_at(rgb_to_grayscale(image), points)

    def refined(
        self, keypoints0: Keypoints, keypoints1: Keypoints, index0: Tensor, index1: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The points (M, 2) of matches in either view.

        They move towards what the mean of both descriptors describes: a keypoint has other points in other pairs.
        """
        descriptors = (keypoints0.descriptors[index0] + keypoints1.descriptors[index1]) / 2
        return self._moved(keypoints0, index0, descriptors), self._moved(keypoints1, index1, descriptors)

    def _moved(self, keypoints: Keypoints, index: Tensor, descriptors: Tensor) -> Tensor:
        assert keypoints.patches is not None  # the encoder's, see :class:`KeypointEncoder`
        moved: Tensor = keypoints.points[index] + self.network(keypoints.patches[index], descriptors)
        return moved


def load_refiner(
    weights: WeightStore, spec: MatcherSpec, refine: Refine, descriptor_dim: int, placement: Placement
) -> Refiner | None:
    """The refiner of a matcher's keypoints; ``None`` if it is not wanted or its weights are not found.

    Raises :class:`mkpc_kaggle.errors.UserError` for weights that are damaged, or missing and wanted always.
    """
    if refine is Refine.NEVER or (refine is Refine.IF_FOUND and weights.find(spec.refiner) is None):
        return None
    network = Keypt2Subpx(descriptor_dim)
    load_into(network, weights.load(spec.refiner), what=spec.refiner)
    return Refiner(network.to(torch.device(placement.device)))
