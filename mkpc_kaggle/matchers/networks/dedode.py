"""DeDoDe descriptors (Edstedt et al. 2024, arXiv 2308.08479) as in LoMa: a dense map, read at keypoints.

B is of VGG-19 alone; G adds DINOv2 at stride 14. Coordinates are normalised as in dad. Parameter names are those
of the public checkpoints. For inference only.
"""

from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.networks.dedode_decoder import DedodeDecoder
from mkpc_kaggle.matchers.networks.dinov2 import DinoV2, DinoV2Config
from mkpc_kaggle.matchers.networks.vgg import VGG19, Vgg

BLOCKS = 5


class Dedode(nn.Module):
    """``encoder``: of features at the ``strides``."""

    def __init__(self, encoder: "Vgg | VggAndVit", strides: tuple[int, ...], channels: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.decoder = DedodeDecoder(strides, channels, BLOCKS, "bilinear")
        self.eval().requires_grad_(False)

    def forward(self, image: Tensor, points: Tensor) -> Tensor:
        """Descriptors (B, K, D) float32, of any length, at points (B, K, 2) of images (B, 3, H, W), RGB in 0..1.

        The images are not normalised. Beyond the image, descriptors fade to 0 within a pixel.
        """
        prediction, hidden = self.decoder(self.encoder.levels(image))
        # The map at full resolution is never computed, only its two parts at the points.
        head = self.decoder.last.out_conv
        weight, bias = (
            parameter[: self.decoder.prediction] for parameter in (head.weight, head.get_parameter("bias"))
        )
        read = functional.grid_sample(hidden.float(), points[:, None], align_corners=False)[:, :, 0]  # (B, 32, K)
        indices, shares = nearest_pixels(points, hidden.shape[2:])
        enlarged = read_enlarged(prediction, indices, shares, hidden.shape[2:])
        fine = functional.linear(read.mT, weight.flatten(1))
        return enlarged + fine + shares.sum(dim=2, keepdim=True) * bias


def nearest_pixels(points: Tensor, size: torch.Size) -> tuple[Tensor, Tensor]:
    """The four pixels (B, K, 4, 2), column and row, around points (B, K, 2), and their bilinear shares (B, K, 4).

    Pixels outside an image of ``size`` (height, width) have weight 0.
    """
    extent = points.new_tensor([size[1], size[0]])
    places = ((points + 1) * extent - 1) / 2
    corners = places.floor()
    steps = points.new_tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
    pixels = corners[:, :, None] + steps
    shares = (1 - (places[:, :, None] - pixels).abs()).prod(dim=3)
    inside = ((pixels >= 0) & (pixels < extent)).all(dim=3)
    return pixels, shares.where(inside, 0)


def read_enlarged(x: Tensor, pixels: Tensor, shares: Tensor, size: torch.Size) -> Tensor:
    """Weighted sums (B, K, C) of pixels (B, K, 4, 2) of a map (B, C, h, w) enlarged bilinearly to ``size``."""
    centres = (2 * pixels + 1) / pixels.new_tensor([size[1], size[0]]) - 1
    read = functional.grid_sample(x, centres, padding_mode="border", align_corners=False)  # (B, C, K, 4)
    return (read * shares[:, None]).sum(dim=3).mT


class VggAndVit(nn.Module):
    """DINOv2's features and VGG's; sides must be multiples of 14."""

    def __init__(self, vit: DinoV2Config | None) -> None:
        super().__init__()
        self.vgg = Vgg(VGG19)
        self.frozen_dinov2 = nn.ModuleDict({"dinov2_vitl14": DinoV2(vit)})

    def levels(self, image: Tensor) -> Iterator[Tensor]:
        yield from self.vgg.levels(image)
        yield self.frozen_dinov2["dinov2_vitl14"](image)


def dedode_b(channels: int) -> Dedode:
    return Dedode(Vgg(VGG19), (8, 4, 2, 1), channels)


def dedode_g(channels: int, vit: DinoV2Config | None = None) -> Dedode:
    """``vit`` of ViT-L/14 unless given."""
    return Dedode(VggAndVit(vit), (14, 8, 4, 2, 1), channels)
