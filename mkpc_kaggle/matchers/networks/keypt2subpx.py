"""Keypt2Subpx: Kim, Pollefeys, Barath, "Learning to Make Keypoints Sub-Pixel Accurate", ECCV 2024.

A patch about a keypoint becomes a descriptor at each of 5 x 5 places. The places that resemble the keypoint's own
descriptor pull it towards themselves. Parameter names are those of the public checkpoints. For inference only.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

PATCH_PX = 11  # side of a patch, the keypoint's pixel in its middle
PLACES = 5  # each way, at which descriptors are computed
STEP_PX = 2.5  # how far a keypoint moves for one place
EPSILON = 1e-6  # in the softmax's denominator


class Keypt2Subpx(nn.Module):
    """``descriptor_dim``: the length of descriptors; ``channels`` of patches, gray and perhaps scores."""

    def __init__(self, descriptor_dim: int, channels: int = 1) -> None:
        super().__init__()
        self.conv1a = nn.Conv2d(channels, 16, 3)
        self.conv1b = nn.Conv2d(16, 16, 3, padding=1)
        self.conv2a = nn.Conv2d(16, 64, 3)
        self.conv2b = nn.Conv2d(64, 64, 3, padding=1)
        self.conv3 = nn.Conv2d(64, descriptor_dim, 3)
        self.eval().requires_grad_(False)

    def forward(self, patches: Tensor, descriptors: Tensor) -> Tensor:
        """Offsets (N, 2), x and y, at most 5 pixels, of ``patches`` (N, C, 11, 11) with ``descriptors`` (N, D)."""
        x = torch.relu_(self.conv1b(torch.relu_(self.conv1a(patches))))
        x = self.conv3(torch.relu_(self.conv2b(torch.relu_(self.conv2a(x)))))
        field = functional.normalize(x, dim=1)  # (N, D, 5, 5)
        weights = torch.einsum("ndrc,nd->nrc", field, descriptors).exp()
        weights = weights / (weights.sum(dim=(1, 2), keepdim=True) + EPSILON)
        places = torch.arange(PLACES, dtype=weights.dtype, device=weights.device)
        expected = torch.stack([weights.sum(dim=1) @ places, weights.sum(dim=2) @ places], dim=1)
        return (expected - PLACES // 2) * STEP_PX


def patches_at(image: Tensor, points: Tensor) -> Tensor:
    """Patches (K, C, 11, 11) of ``image`` (C, H, W) about ``points`` (K, 2), whose fractions are cut off.

    Zeros are beyond the border. A point on the last column or row gets its neighbour's patch, as when the weights
    were trained.
    """
    height, width = image.shape[1:]
    padded = functional.pad(image, (PATCH_PX // 2,) * 4)
    windows = padded.unfold(1, PATCH_PX, 1).unfold(2, PATCH_PX, 1)  # (C, H, W, 11, 11), a view
    columns = points[:, 0].long().clamp(0, max(width - 2, 0))
    rows = points[:, 1].long().clamp(0, max(height - 2, 0))
    return windows[:, rows, columns].transpose(0, 1).contiguous()
