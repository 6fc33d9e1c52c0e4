"""Pictures as networks see them."""

import torch
from torch import Tensor
from torch.nn import functional

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of the colours of ImageNet's pictures, in 0..1


def resized(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Images (B, C, H, W) uint8 on the CPU -> (B, C, *size) float32 in 0..1.

    Bicubic with antialiasing in 8 bits, the width first, as by Pillow up to version 12, with which networks are
    trained: about a hundredth of the values differ, by a grey level or two. Pillow 13 begins with the height where
    it shrinks and the width grows; there a fifth of the values differ or more.
    """
    if pixels.shape[2:] != size:
        pixels = functional.interpolate(pixels, size, mode="bicubic", antialias=True, align_corners=False)
    return pixels.float().div_(255)


def network_input(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """RGB images (B, 3, H, W) uint8 on the CPU -> (B, 3, *size) float32, resized and normalised.

    The second pass needs the image itself resized anew.
    """
    mean, std = (torch.tensor(values)[:, None, None] for values in (MEAN, STD))
    return resized(pixels, size).sub_(mean).div_(std)
