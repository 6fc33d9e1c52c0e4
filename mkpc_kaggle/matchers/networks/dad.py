"""DaD, a keypoint detector: the strongest maxima of a map of logits (Edstedt et al. 2025).

arXiv 2503.07347, as used by LoMa.

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
        """Return up to ``number`` points for each of the images (B, 3, H, W), RGB in 0..1.

        Sides are at least 8. In training they were multiples of 8, and the longer one was 1024.
        """
        maps = self.logits(image)
        check_finite("keypoint scores of loma", maps)
        return [select_keypoints(logits, number) for logits in maps]

    def logits(self, image: Tensor) -> Tensor:
        """Return logits (B, H, W) float32."""
        prediction, hidden = self.decoder(self.levels(image))
        # The context of the last stride, its other channel, has no reader.
        part = self.decoder.at(1).outputs(hidden)[:, :1]
        return resize(prediction, part.shape[2:], "bicubic").add_(part)[:, 0]

    def levels(self, image: Tensor) -> Iterator[Tensor]:
        """Return the features at strides 1, 2, 4 and 8."""
        # The descriptor's input is not normalised, the detector's is.
        mean = image.new_tensor(MEAN)[:, None, None]  # (3, 1, 1)
        std = image.new_tensor(STD)[:, None, None]
        return self.encoder.levels((image - mean) / std)


def select_keypoints(logits: Tensor, number: int) -> Tensor:
    """Return the ``number`` highest maxima over 3 x 3 pixels of a map (H, W).

    All equal maxima of a window count. Points (K, 2) are float32, normalised, the most probable
    first, and up to half a pixel beyond the edges.
    """
    height, width = logits.shape
    # Over all pixels of the image, as in training.
    probability = logits.flatten().softmax(dim=0).view(1, height, width)
    is_maximum = probability == window_maximum(probability, 1)
    maxima = probability.where(is_maximum, 0).flatten()
    scores, pixels = maxima.topk(min(number, len(maxima)))
    # The published code fills up with arbitrary pixels of probability 0.
    pixels = pixels[scores > 0]
    rows = pixels // width
    columns = pixels % width
    positions = torch.stack([columns, rows], dim=1) + subpixel_offsets(logits, rows, columns)
    return (2 * positions + 1) / positions.new_tensor([width, height]) - 1


def subpixel_offsets(logits: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Return offsets (K, 2) float32 in pixels, within -1..1, of pixels (K,) of a map (H, W).

    They are means under a softmax of 3 x 3 logits. As in training, logits beyond the map are 0.
    """
    padded = functional.pad(logits, (1, 1, 1, 1))
    steps = torch.arange(3, device=logits.device)
    window_rows = (rows[:, None] + steps)[:, :, None]  # (K, 3, 1)
    window_columns = (columns[:, None] + steps)[:, None]  # (K, 1, 3)
    windows = padded[window_rows, window_columns]  # (K, 3, 3)
    shares = (windows.flatten(1) / TEMPERATURE).softmax(dim=1).view_as(windows)
    moves = steps.float() - 1
    x = shares.sum(dim=1) @ moves
    y = shares.sum(dim=2) @ moves
    return torch.stack([x, y], dim=1)
