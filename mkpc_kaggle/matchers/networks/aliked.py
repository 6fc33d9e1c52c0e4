"""ALIKED: Zhao et al., "ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable
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
RADIUS = 2  # of suppression and of refinement, in pixels
TEMPERATURE = 0.1  # of the softmax in the refinement window
PATCH = 3  # pixels per axis from which a keypoint's offsets are computed
POSITIONS_AT_ONCE = 1024  # intermediate maps fit a CPU's cache


class Aliked(nn.Module):
    """ALIKED. ``max_keypoints``: the number of strongest keypoints kept in each image.

    ``positions``: points around a keypoint at which its descriptor is sampled, 16 or 32 as published.
    """

    def __init__(self, max_keypoints: int, positions: int = 16) -> None:
        super().__init__()
        self.max_keypoints = max_keypoints
        c1, c2, c3, c4 = CHANNELS
        self.block1 = AlikedBlock(conv3x3, 3, c1)
        self.block2 = AlikedResidualBlock(conv3x3, c1, c2)
        self.block3 = AlikedResidualBlock(DeformableConv2d, c2, c3)
        self.block4 = AlikedResidualBlock(DeformableConv2d, c3, c4)
        self.conv1, self.conv2, self.conv3, self.conv4 = (
            nn.Conv2d(channels, c4 // 4, 1, bias=False) for channels in CHANNELS
        )
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
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stubs

    def forward(self, images: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return each image's K keypoints, best first: points (K, 2) float32, x and y in pixels
        with centres at integers, and unit descriptors (K, 128) float32.

        Images (B, 3, H, W) float32 RGB in [0, 1], sides multiples of 32.
        """
        maps = self.maps(images)
        points = [
            refined_maxima(scores, strict_maxima(scores, self.max_keypoints))
            for scores in self.score_map(maps)
        ]
        counts = [len(each) for each in points]
        image = torch.arange(len(points), device=images.device).repeat_interleave(
            torch.tensor(counts, device=images.device)
        )
        descriptors = self.desc_head(JoinedMap(self, maps), torch.cat(points), image)
        return list(zip(points, torch.split(descriptors, counts), strict=True))

    def maps(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the input (B, c1, H, W) of the part at stride 1, and the parts at strides 2, 8 and
        32.
        """
        # Channels first: with three channels the convolution is faster; its result is channels
        # last.
        x1 = self.block1(images.contiguous().to(self.conv1.weight.dtype))
        x2 = self.block2(functional.avg_pool2d(x1, 2))
        x3 = self.block3(functional.avg_pool2d(x2, 4))
        x4 = self.block4(functional.avg_pool2d(x3, 4))
        coarse = ((self.conv2, x2), (self.conv3, x3), (self.conv4, x4))
        part2, part3, part4 = (torch.selu_(conv(x)) for conv, x in coarse)
        return x1, part2, part3, part4

    def score_map(self, maps: tuple[Tensor, ...]) -> Tensor:
        """Return scores (B, H, W) float32 in (0, 1)."""
        x1, *parts = maps
        # (8, C / 4, 1, 1) each: a 1x1 convolution may precede upsampling.
        weights = self.score_head.get_parameter("0.weight").chunk(4, dim=1)

        def first(rows: Tensor) -> Tensor:
            return functional.conv2d(torch.selu_(self.conv1(rows)).float(), weights[0])

        total = in_strips(first, x1, reach=0, channels=CHANNELS[-1] // 4)
        for part, weight in zip(parts, weights[1:], strict=True):
            total += enlarged(functional.conv2d(part.float(), weight), x1.shape[2:])
        logits: Tensor = self.score_head[1:](total)
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

    def forward(self, x: Tensor) -> Tensor:
        return torch.selu_(self.bn2(self.conv2(torch.selu_(self.bn1(self.conv1(x))))))


class AlikedResidualBlock(AlikedBlock):
    def __init__(self, conv: Convolution, channels: int, out_channels: int) -> None:
        super().__init__(conv, channels, out_channels)
        self.downsample = nn.Conv2d(channels, out_channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        out = self.bn2(self.conv2(torch.selu_(self.bn1(self.conv1(x)))))
        return torch.selu_(out + self.downsample(x))


class JoinedMap:
    """The unit features of the full-size map, computed only at the requested pixels."""

    def __init__(self, network: Aliked, maps: tuple[Tensor, ...]) -> None:
        self._conv1 = network.conv1
        x1, *parts = maps
        self.size = x1.shape[2:]
        self._tables = [as_grid(x1).flatten(0, 2), *map(table_of, parts)]
        self._sizes = [part.shape[2:] for part in parts]

    def at(self, pixels: Tensor) -> Tensor:
        """Return (P, C) float32 at pixels (P,) int64 of the table of the full-size map."""
        height, width = self.size
        full, *tables = self._tables
        image = pixels // (height * width)
        positions = torch.stack([pixels % width, pixels // width % height], dim=1).float()
        parts = [torch.selu_(pointwise(self._conv1, full.index_select(0, pixels)).float())]
        for table, size in zip(tables, self._sizes, strict=True):
            # Both maps share the centres of their corner pixels.
            ratio = positions.new_tensor(
                [(size[1] - 1) / (width - 1), (size[0] - 1) / (height - 1)]
            )
            parts.append(weighted_rows(table, *corners(positions * ratio, image, size)))
        return functional.normalize(torch.cat(parts, dim=1), dim=1)

    def sampled(self, positions: Tensor, image: Tensor) -> Tensor:
        """Sample at positions (Q, 2) of the images ``image`` (Q,): (Q, C) float32, zero outside."""
        pixels, weights = corners(positions, image, self.size)  # (Q, 4)
        blocks = zip(
            *(torch.split(values, POSITIONS_AT_ONCE) for values in (pixels, weights)), strict=True
        )
        return torch.cat(
            [
                torch.einsum("qkc,qk->qc", self.at(some.flatten()).view(len(some), 4, -1), shares)
                for some, shares in blocks
            ]
        )


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
        corner = (points.long() - 1).clamp_(min=0)
        # As trained
        corner = torch.minimum(corner, corner.new_tensor([width - PATCH - 1, height - PATCH - 1]))
        steps = torch.arange(PATCH, device=points.device)
        rows = (image * height + corner[:, 1])[:, None] + steps  # (K, 3)
        patches = (rows * width)[:, :, None] + (corner[:, :1] + steps)[:, None]  # (K, 3, 3)
        offsets = self.offsets(
            joined.at(patches.flatten()).view(len(points), -1), max(height, width) / 4
        )

        positions = (points[:, None] + offsets).flatten(0, 1)  # (K M, 2)
        read = joined.sampled(positions, image.repeat_interleave(offsets.shape[1]))  # (K M, C)
        read = torch.selu_(pointwise(self.sf_conv, read)).view(len(points), -1)
        return functional.normalize(linear(read, self.agg_weights.flatten(0, 1).T), dim=1)

    def offsets(self, patches: Tensor, reach: float) -> Tensor:
        """Map patches (K, 9 C), row by row, to (x, y) offsets (K, M, 2) in pixels."""
        whole, bias, last, last_bias = (
            self.offset_conv.get_parameter(name)
            for name in ("0.weight", "0.bias", "2.weight", "2.bias")
        )
        hidden = torch.selu_(linear(patches, whole.permute(0, 2, 3, 1).flatten(1), bias))
        moved = linear(hidden, last.flatten(1), last_bias).clamp_(-reach, reach)
        return moved.view(len(patches), 2, -1).mT


def enlarged(maps: Tensor, size: torch.Size) -> Tensor:
    """Enlarge bilinearly; the centres of the corner pixels stay at the corners."""
    return functional.interpolate(maps, tuple(size), mode="bilinear", align_corners=True)


def strict_maxima(scores: Tensor, count: int) -> Tensor:
    """Return the best strict maxima of a map (H, W), best first: (K,) int64. Published code keeps
    more.
    """
    peaks = scores == functional.max_pool2d(scores[None], 2 * RADIUS + 1, 1, RADIUS)[0]
    inner = torch.zeros_like(peaks)
    inner[RADIUS:-RADIUS, RADIUS:-RADIUS] = True
    index = (peaks & inner).flatten().nonzero()[:, 0]
    window = windows(scores, index)
    index = index[(window == window.amax(dim=1, keepdim=True)).sum(dim=1) == 1]
    return index[scores.flatten()[index].topk(min(count, len(index))).indices]


def refined_maxima(scores: Tensor, index: Tensor) -> Tensor:
    """Move the maxima (K,) of a map (H, W) by a softmax's mean offset in their windows: (K, 2), x
    and y.
    """
    shares = torch.softmax(windows(scores, index) / TEMPERATURE, dim=1)  # (K, 25)
    steps = torch.arange(-RADIUS, RADIUS + 1, device=scores.device).float()
    offsets = shares @ torch.cartesian_prod(steps, steps).flip(1)
    width = scores.shape[1]
    return torch.stack([index % width, index // width], dim=1) + offsets


def windows(scores: Tensor, index: Tensor) -> Tensor:
    """Return the scores (K, 25) around inner pixels (K,) of a map (H, W), row by row."""
    steps = torch.arange(-RADIUS, RADIUS + 1, device=scores.device)
    around = (steps[:, None] * scores.shape[1] + steps).flatten()
    return scores.flatten()[index[:, None] + around]


def own_name(name: str) -> str:
    """Return our name of a checkpoint's parameter: here the module is the convolution itself."""
    return name.replace(".regular_conv.", ".")
