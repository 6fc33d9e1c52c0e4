"""Input images of networks."""

import torch
from torch import Tensor
from torch.nn import functional

# Mean and standard deviation of ImageNet's red, green and blue, in 0..1.
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)


def resized(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize images (B, C, H, W) uint8 on the CPU to (B, C, *size) float32 in 0..1.

    Bicubic with antialiasing in 8 bits, the width first, as in training with Pillow up to version
    12. About 1 % of the values differ from Pillow's, by one or two grey levels. Pillow 13 resizes a
    shrinking height before a growing width; then at least 20 % of the values differ.
    """
    # An image of the right size keeps its pixels: Pillow does not filter it either.
    if pixels.shape[2:] != size:
        pixels = functional.interpolate(
            pixels, size, mode="bicubic", antialias=True, align_corners=False
        )
    return pixels.float().div_(255)


def network_input(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize and normalise RGB images (B, 3, H, W) uint8 on the CPU to (B, 3, *size) float32.

    For the second pass, call this with the original images again.
    """
    mean = torch.tensor(MEAN)[:, None, None]  # (3, 1, 1)
    std = torch.tensor(STD)[:, None, None]
    return resized(pixels, size).sub_(mean).div_(std)
