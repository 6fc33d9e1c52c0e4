"""DaD, a keypoint detector (Edstedt et al. 2025, arXiv 2503.07347): a map of logits and its
strongest maxima.

Normalised coordinates: (x, y) in [-1, 1], where +-1 are the outer edges of an image. Parameter
names match the public checkpoint. For inference only.
"""

from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.dedode import DedodeDecoder
from mkpc_kaggle.matchers.networks.layers import resize
from mkpc_kaggle.matchers.networks.pixels import MEAN, STD
from mkpc_kaggle.matchers.networks.superpoint import window_maximum
from mkpc_kaggle.matchers.networks.vgg import VGG11, Vgg

TEMPERATURE = 0.5  # of the softmax over 3 x 3 pixels that refines a keypoint to subpixels


class Dad(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.encoder = Vgg(VGG11)
        self.decoder = DedodeDecoder((8, 4, 2, 1), prediction=1, blocks=3, mode="bicubic")
        self.eval().requires_grad_(False)

    def forward(self, image: Tensor, number: int) -> list[Tensor]:
        """Return up to ``number`` points for each of the images (B, 3, H, W), RGB in 0..1, sides at
        least 8.

        In training, sides were multiples of 8, and the longer one was 1024.
        """
        maps = self.logits(image)
        check_finite("keypoint scores of loma", maps)
        return [select_keypoints(logits, number) for logits in maps]

    def logits(self, image: Tensor) -> Tensor:
        """Return logits (B, H, W) float32."""
        prediction, hidden = self.decoder(self.levels(image))
        part = self.decoder.at(1).outputs(hidden)[:, :1]
        return resize(prediction, part.shape[2:], "bicubic").add_(part)[:, 0]

    def levels(self, image: Tensor) -> Iterator[Tensor]:
        """Return the features at strides 1, 2, 4 and 8."""
        mean, std = (image.new_tensor(values)[:, None, None] for values in (MEAN, STD))
        return self.encoder.levels((image - mean) / std)


def select_keypoints(logits: Tensor, number: int) -> Tensor:
    """Return the ``number`` highest maxima over 3 x 3 pixels of a map (H, W). All equal maxima of a
    window count.

    Points (K, 2) are float32, normalised, the most probable first, and up to half a pixel beyond
    the edges.
    """
    height, width = logits.shape
    probability = logits.flatten().softmax(dim=0).view(1, height, width)
    maxima = probability.where(probability == window_maximum(probability, 1), 0).flatten()
    scores, pixels = maxima.topk(min(number, len(maxima)))
    pixels = pixels[scores > 0]
    rows, columns = pixels // width, pixels % width
    places = torch.stack([columns, rows], dim=1) + subpixel_offsets(logits, rows, columns)
    return (2 * places + 1) / places.new_tensor([width, height]) - 1


def subpixel_offsets(logits: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Return offsets (K, 2) float32 in pixels, within -1..1: softmax means around pixels (K,) of a
    map (H, W).

    As in training, logits beyond the map are 0.
    """
    padded = functional.pad(logits, (1, 1, 1, 1))
    steps = torch.arange(3, device=logits.device)
    # (K, 3, 3)
    windows = padded[(rows[:, None] + steps)[:, :, None], (columns[:, None] + steps)[:, None]]
    shares = (windows.flatten(1) / TEMPERATURE).softmax(dim=1).view_as(windows)
    moves = steps.float() - 1
    return torch.stack([shares.sum(dim=1) @ moves, shares.sum(dim=2) @ moves], dim=1)
