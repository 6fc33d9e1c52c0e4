"""Pictures as networks see them."""

from torch import Tensor
from torch.nn import functional


def resized(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Images (B, C, H, W) uint8 on the CPU -> (B, C, *size) float32 in 0..1.

    Bicubic with antialiasing in 8 bits; differs from PIL, with which networks are trained, by a grey level in
    about a hundredth of the values.
    """
    if pixels.shape[2:] != size:
        pixels = functional.interpolate(pixels, size, mode="bicubic", antialias=True, align_corners=False)
    return pixels.float().div_(255)
