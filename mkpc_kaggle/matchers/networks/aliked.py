"""ALIKED, keypoints and descriptors of an image.

Source: Zhao et al., "ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable
Transformation", IEEE Transactions on Instrumentation and Measurement 2023.

Four scales are joined at full size. Every pixel has a score; descriptors are read at offsets around
each keypoint. The joined map is never stored: scores need 8 channels of it, and descriptors a few
thousand pixels. Parameter names match the public checkpoints, except for ``regular_conv`` (see
:func:`own_name`). For inference only.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.matchers.dtypes import check_finite
from mkpc_kaggle.matchers.networks.bilinear import (
    DeformableConv2d,
    corners,
    table_of,
    weighted_rows,
)
from mkpc_kaggle.matchers.networks.grids import as_grid, pointwise
from mkpc_kaggle.matchers.networks.layers import ExactConv2d, in_strips, linear

# The same for all published variants: channels of the four scales; the last is also the
# descriptors'.
CHANNELS = (16, 32, 64, 128)
PARTS = len(CHANNELS)  # each scale gives a quarter of the joined map's channels
RADIUS = 2  # of suppression and of refinement, in pixels
TEMPERATURE = 0.1  # of the softmax in the refinement window
PATCH = 3  # pixels per axis from which a keypoint's offsets are computed
# On a CPU, intermediate maps fit its cache. A GPU is idle between small blocks: with 65,536 two images of
# 1,024 pixels take 0.03 instead of 0.20 s on an H100, with equal results.
POSITIONS_AT_ONCE = {"cpu": 1024, "cuda": 65536}


class Aliked(nn.Module):
    """ALIKED. ``max_keypoints``: the number of strongest keypoints kept in each image.

    ``positions``: points around a keypoint where its descriptor is sampled, 16 or 32 as published.
    """

    def __init__(self, max_keypoints: int, positions: int = 16) -> None:
        super().__init__()
        self.max_keypoints = max_keypoints
        c1, c2, c3, c4 = CHANNELS
        # Only the two coarse scales have deformable convolutions.
        self.block1 = AlikedBlock(conv3x3, 3, c1)
        self.block2 = AlikedResidualBlock(conv3x3, c1, c2)
        self.block3 = AlikedResidualBlock(DeformableConv2d, c2, c3)
        self.block4 = AlikedResidualBlock(DeformableConv2d, c3, c4)
        self.conv1 = nn.Conv2d(c1, c4 // PARTS, 1, bias=False)
        self.conv2 = nn.Conv2d(c2, c4 // PARTS, 1, bias=False)
        self.conv3 = nn.Conv2d(c3, c4 // PARTS, 1, bias=False)
        self.conv4 = nn.Conv2d(c4, c4 // PARTS, 1, bias=False)
        self.score_head = nn.Sequential(
            ExactConv2d(c4, 8, 1, bias=False),
            nn.SELU(inplace=True),
            ExactConv2d(8, 4, 3, padding=1, bias=False),
            nn.SELU(inplace=True),
            ExactConv2d(4, 4, 3, padding=1, bias=False),
            nn.SELU(inplace=True),
            ExactConv2d(4, 1, 3, padding=1, bias=False),
        )
        self.desc_head = DescriptorHead(positions)
        self.eval().requires_grad_(False)
        # Channels-last weights make all maps channels last; loading a checkpoint keeps that.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stubs

    def forward(self, images: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return points (K, 2) and descriptors (K, 128) of each image's K keypoints, best first.

        Images (B, 3, H, W) are float32 RGB in [0, 1], sides multiples of 32. Points are float32, x
        and y in pixels with centres at integers; descriptors are float32 unit vectors.
        """
        maps = self.maps(images)
        points = []
        for scores in self.score_map(maps):
            maxima = strict_maxima(scores, self.max_keypoints)
            points.append(refined_maxima(scores, maxima))

        # One call describes the keypoints of all images; ``image`` (sum of K,) is their image.
        counts = [len(each) for each in points]
        numbers = torch.arange(len(points), device=images.device)
        image = numbers.repeat_interleave(torch.tensor(counts, device=images.device))
        descriptors = self.desc_head(JoinedMap(self, maps), torch.cat(points), image)
        return list(zip(points, torch.split(descriptors, counts), strict=True))

    def maps(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the features (B, c1, H, W) at stride 1, and the parts at strides 2, 8 and 32.

        A part (B, C / 4, h, w) is a quarter of the joined map's channels. That of stride 1 is
        computed where it is read.
        """
        # Channels first: with three channels the convolution is faster; its result is channels
        # last.
        x1 = self.block1(images.contiguous().to(self.conv1.weight.dtype))
        x2 = self.block2(functional.avg_pool2d(x1, 2))
        x3 = self.block3(functional.avg_pool2d(x2, 4))
        x4 = self.block4(functional.avg_pool2d(x3, 4))
        part2 = torch.selu_(self.conv2(x2))
        part3 = torch.selu_(self.conv3(x3))
        part4 = torch.selu_(self.conv4(x4))
        return x1, part2, part3, part4

    def score_map(self, maps: tuple[Tensor, ...]) -> Tensor:
        """Return scores (B, H, W) float32 in (0, 1)."""
        x1, *parts = maps
        # The head's first layer is a sum over the four parts. A 1x1 convolution and enlargement
        # commute, so only its 8 channels are enlarged. (8, C / 4, 1, 1) each.
        weights = self.score_head.get_parameter("0.weight").chunk(PARTS, dim=1)

        def first(rows: Tensor) -> Tensor:
            return functional.conv2d(torch.selu_(self.conv1(rows)).float(), weights[0])

        total = in_strips(first, x1, reach=0, channels=CHANNELS[-1] // 4)
        for part, weight in zip(parts, weights[1:], strict=True):
            total += enlarged(functional.conv2d(part.float(), weight), x1.shape[2:])
        logits: Tensor = self.score_head[1:](total)
        # Here, because the sigmoid would hide an infinite logit.
        check_finite("keypoint scores of aliked", logits)
        return logits[:, 0].sigmoid_()


Convolution = Callable[[int, int], nn.Conv2d]  # (input channels, output channels)


def conv3x3(channels: int, out_channels: int) -> nn.Conv2d:
    return nn.Conv2d(channels, out_channels, 3, padding=1, bias=False)


class AlikedBlock(nn.Module):
    """Two 3x3 convolutions, each with a batch norm and a SELU."""

    def __init__(self, conv: Convolution, channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv1 = conv(channels, out_channels)
        self.bn1 = nn.BatchNorm2d(out_channels)
        self.conv2 = conv(out_channels, out_channels)
        self.bn2 = nn.BatchNorm2d(out_channels)

    def convolved(self, x: Tensor) -> Tensor:
        """Return the map before the last SELU."""
        hidden = torch.selu_(self.bn1(self.conv1(x)))
        mapped: Tensor = self.bn2(self.conv2(hidden))
        return mapped

    def forward(self, x: Tensor) -> Tensor:
        return torch.selu_(self.convolved(x))


class AlikedResidualBlock(AlikedBlock):
    """The same with a shortcut, a 1x1 convolution, which is added before the last SELU."""

    def __init__(self, conv: Convolution, channels: int, out_channels: int) -> None:
        super().__init__(conv, channels, out_channels)
        self.downsample = nn.Conv2d(channels, out_channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        return torch.selu_(self.convolved(x) + self.downsample(x))


class JoinedMap:
    """The unit features of the full-size map, computed only at the requested pixels."""

    def __init__(self, network: Aliked, maps: tuple[Tensor, ...]) -> None:
        self._conv1 = network.conv1
        x1, *parts = maps
        self.size = x1.shape[2:]
        # In the network's precision: only its selected rows are converted.
        self._full = as_grid(x1).flatten(0, 2)  # (B H W, c1)
        self._tables = [table_of(part) for part in parts]  # (B h w, C / 4)
        self._sizes = [part.shape[2:] for part in parts]

    def at(self, pixels: Tensor) -> Tensor:
        """Return (P, C) float32 at pixels (P,) int64 of the table of the full-size map."""
        height, width = self.size
        image = pixels // (height * width)
        columns = pixels % width
        rows = pixels // width % height
        positions = torch.stack([columns, rows], dim=1).float()
        features = pointwise(self._conv1, self._full.index_select(0, pixels))
        parts = [torch.selu_(features.float())]
        for table, size in zip(self._tables, self._sizes, strict=True):
            # Both maps share the centres of their corner pixels, as in :func:`enlarged`.
            ratio_x = (size[1] - 1) / (width - 1)
            ratio_y = (size[0] - 1) / (height - 1)
            ratio = positions.new_tensor([ratio_x, ratio_y])
            index, weights = corners(positions * ratio, image, size)
            parts.append(weighted_rows(table, index, weights))
        # The order of the parts is the order of the joined map's channels.
        return functional.normalize(torch.cat(parts, dim=1), dim=1)

    def sampled(self, positions: Tensor, image: Tensor) -> Tensor:
        """Sample at positions (Q, 2) of the images ``image`` (Q,): (Q, C) float32, zero outside."""
        pixels, weights = corners(positions, image, self.size)  # (Q, 4)
        sums = []
        at_once = POSITIONS_AT_ONCE.get(positions.device.type, 1024)
        blocks = zip(
            torch.split(pixels, at_once),
            torch.split(weights, at_once),
            strict=True,
        )
        for some, shares in blocks:
            features = self.at(some.flatten()).view(len(some), 4, -1)  # (q, 4, C)
            sums.append(torch.einsum("qkc,qk->qc", features, shares))
        return torch.cat(sums)


class DescriptorHead(nn.Module):
    """Features at positions around each keypoint, weighted by learned maps."""

    def __init__(self, positions: int) -> None:
        super().__init__()
        channels = CHANNELS[-1]
        self.offset_conv = nn.Sequential(
            ExactConv2d(channels, 2 * positions, PATCH),
            nn.SELU(inplace=True),
            ExactConv2d(2 * positions, 2 * positions, 1),
        )
        self.sf_conv = ExactConv2d(channels, channels, 1, bias=False)
        self.agg_weights = nn.Parameter(torch.zeros(positions, channels, channels))

    def forward(self, joined: JoinedMap, points: Tensor, image: Tensor) -> Tensor:
        """Return descriptors (K, C) at points (K, 2) of the images ``image`` (K,)."""
        if len(points) == 0:
            return points.new_zeros(0, self.agg_weights.shape[2])
        height, width = joined.size
        # The patch's top-left pixel (K, 2), (x, y). As trained, patches end one pixel before the
        # image's right and bottom edge.
        corner = (points.long() - 1).clamp_(min=0)
        last = corner.new_tensor([width - PATCH - 1, height - PATCH - 1])
        corner = torch.minimum(corner, last)
        steps = torch.arange(PATCH, device=points.device)
        rows = (image * height + corner[:, 1])[:, None] + steps  # (K, 3)
        columns = corner[:, :1] + steps  # (K, 3)
        pixels = (rows * width)[:, :, None] + columns[:, None]  # (K, 3, 3)
        patches = joined.at(pixels.flatten()).view(len(points), -1)  # (K, 9 C)
        # As trained, a position is at most a quarter of the longer side away.
        offsets = self.offsets(patches, max(height, width) / 4)  # (K, M, 2)

        positions = (points[:, None] + offsets).flatten(0, 1)  # (K M, 2)
        read = joined.sampled(
            positions, image.repeat_interleave(offsets.shape[1])
        )  # (K M, C)
        read = torch.selu_(pointwise(self.sf_conv, read)).view(len(points), -1)  # (K, M C)
        # The sum over positions of a matrix each is one product with the stacked matrices.
        mixed = linear(read, self.agg_weights.flatten(0, 1).T)
        return functional.normalize(mixed, dim=1)

    def offsets(self, patches: Tensor, reach: float) -> Tensor:
        """Map patches (K, 9 C), row by row, to (x, y) offsets (K, M, 2) in pixels."""
        # A convolution of a patch by a kernel of its size is a matrix product.
        first = self.offset_conv.get_parameter("0.weight")  # (2 M, C, 3, 3)
        first_bias = self.offset_conv.get_parameter("0.bias")
        last = self.offset_conv.get_parameter("2.weight")  # (2 M, 2 M, 1, 1)
        last_bias = self.offset_conv.get_parameter("2.bias")
        rows = first.permute(0, 2, 3, 1).flatten(
            1
        )  # (2 M, 9 C): pixel by pixel, like patches
        hidden = torch.selu_(linear(patches, rows, first_bias))
        moved = linear(hidden, last.flatten(1), last_bias).clamp_(-reach, reach)
        # The first M channels are x, the others y.
        return moved.view(len(patches), 2, -1).mT


def enlarged(maps: Tensor, size: torch.Size) -> Tensor:
    """Enlarge bilinearly; the centres of the corner pixels stay at the corners."""
    return functional.interpolate(maps, tuple(size), mode="bilinear", align_corners=True)


def strict_maxima(scores: Tensor, count: int) -> Tensor:
    """Return the best strict maxima of a map (H, W) as pixels (K,) int64, best first.

    Published code keeps more: several equal maxima of one window.
    """
    largest = functional.max_pool2d(scores[None], 2 * RADIUS + 1, 1, RADIUS)[0]
    peaks = scores == largest
    # Refinement needs a whole window.
    inner = torch.zeros_like(peaks)
    inner[RADIUS:-RADIUS, RADIUS:-RADIUS] = True
    index = (peaks & inner).flatten().nonzero()[:, 0]
    # Of a plateau none is kept: a constant area would be full of keypoints.
    window = windows(scores, index)
    is_maximum = window == window.amax(dim=1, keepdim=True)
    index = index[is_maximum.sum(dim=1) == 1]
    best = scores.flatten()[index].topk(min(count, len(index)))
    return index[best.indices]


def refined_maxima(scores: Tensor, index: Tensor) -> Tensor:
    """Return the maxima (K,) of a map (H, W) with subpixels: (K, 2), x and y.

    A maximum moves by the mean offset of its window under a softmax of the scores.
    """
    shares = torch.softmax(windows(scores, index) / TEMPERATURE, dim=1)  # (K, 25)
    steps = torch.arange(-RADIUS, RADIUS + 1, device=scores.device).float()
    moves = torch.cartesian_prod(steps, steps).flip(1)  # (25, 2): x, y; row by row
    width = scores.shape[1]
    pixels = torch.stack([index % width, index // width], dim=1)
    return pixels + shares @ moves


def windows(scores: Tensor, index: Tensor) -> Tensor:
    """Return the scores (K, 25) around inner pixels (K,) of a map (H, W), row by row."""
    steps = torch.arange(-RADIUS, RADIUS + 1, device=scores.device)
    around = (steps[:, None] * scores.shape[1] + steps).flatten()
    return scores.flatten()[index[:, None] + around]


def own_name(name: str) -> str:
    """Return our name of a checkpoint's parameter: here the module is the convolution itself."""
    return name.replace(".regular_conv.", ".")
