"""SuperPoint: keypoints of a gray image and their descriptors (DeTone et al. 2018).

arXiv 1712.07629.
Parameter names match ``superpoint_v1.pth``; its terms (noncommercial research) apply to every use.
The computation is the one published with SuperGlue's weights, including an error in the sampling of
descriptors. Pixel centres are at integers, as everywhere in the package.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.matchers.dtypes import check_finite

CELL = 8  # pixels: the stride of the features
BORDER = 4  # pixels: the width of a margin without keypoints
SUPPRESSION_ROUNDS = 2  # each recovers points that only suppressed points exceed


class SuperPointKeypoints(NamedTuple):
    """K keypoints of one image, all float32.

    ``points`` (K, 2): whole pixels (x, y). ``scores`` (K,): in 0..1. ``descriptors`` (K, 256): unit
    vectors. ``size``: of the image. Ordered by descending score if there were more than
    ``max_keypoints``, else by row and column.
    """

    points: Tensor
    scores: Tensor
    descriptors: Tensor
    size: Size


class SuperPoint(nn.Module):
    """A trunk of eight convolutions, a detector head (Pa, Pb) and a descriptor head (Da, Db).

    ``nms_radius``: half the suppression window, in pixels. Scores are above ``keypoint_threshold``.
    ``max_keypoints``: the number to keep, -1 for all. SuperGlue's published results use, in this
    order, 3, 0.005, 2048 outdoors and 4, 0.005, 1024 indoors. For inference only.
    """

    def __init__(
        self, nms_radius: int = 4, keypoint_threshold: float = 0.005, max_keypoints: int = -1
    ) -> None:
        super().__init__()
        self.nms_radius = nms_radius
        self.keypoint_threshold = keypoint_threshold
        self.max_keypoints = max_keypoints
        self.conv1a = nn.Conv2d(1, 64, 3, padding=1)
        self.conv1b = nn.Conv2d(64, 64, 3, padding=1)
        self.conv2a = nn.Conv2d(64, 64, 3, padding=1)
        self.conv2b = nn.Conv2d(64, 64, 3, padding=1)
        self.conv3a = nn.Conv2d(64, 128, 3, padding=1)
        self.conv3b = nn.Conv2d(128, 128, 3, padding=1)
        self.conv4a = nn.Conv2d(128, 128, 3, padding=1)
        self.conv4b = nn.Conv2d(128, 128, 3, padding=1)
        self.convPa = nn.Conv2d(128, 256, 3, padding=1)
        self.convPb = nn.Conv2d(256, CELL * CELL + 1, 1)  # a cell's pixels and "no keypoint"
        self.convDa = nn.Conv2d(128, 256, 3, padding=1)
        self.convDb = nn.Conv2d(256, 256, 1)
        self.eval().requires_grad_(False)
        # A one-channel image has no definite layout, so the weights' layout decides.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stubs

    def forward(self, image: Tensor) -> list[SuperPointKeypoints]:
        """Return the keypoints of each of the images (B, 1, H, W), gray in 0..1.

        Rows and columns beyond the last multiple of 8 have no keypoints; a side below 8 has none.
        """
        batch, _, height, width = image.shape
        size = Size(width, height)
        # The third max pool would have no pixel left.
        if min(size) < CELL:
            none = image.new_zeros(0)
            empty = SuperPointKeypoints(none.view(0, 2), none, none.view(0, 256), size)
            return [empty] * batch
        features = self.features(image)
        logits = self.logits(features)
        check_finite("keypoint scores of superpoint", logits)
        scores = suppress_non_maxima(score_map(logits), self.nms_radius)
        found = []
        for of_image, field in zip(scores, self.descriptor_field(features), strict=True):
            points, kept = self.select_keypoints(of_image)
            found.append(
                SuperPointKeypoints(points, kept, sample_descriptors(field, points), size)
            )
        return found

    def features(self, image: Tensor) -> Tensor:
        """Return the trunk's output (B, 128, h, w) for (B, 1, H, W); h and w are H / 8 and W / 8.

        Halves are rounded down.
        """
        x = image.to(self.conv1a.weight.dtype)
        for first, second in (
            (self.conv1a, self.conv1b),
            (self.conv2a, self.conv2b),
            (self.conv3a, self.conv3b),
        ):
            # Pool first, so that the ReLU has a quarter of the values. It is monotonic, so the
            # order has no effect on the result.
            x = torch.relu_(functional.max_pool2d(second(torch.relu_(first(x))), 2))
        return torch.relu_(self.conv4b(torch.relu_(self.conv4a(x))))

    def logits(self, features: Tensor) -> Tensor:
        """Return logits (B, 65, h, w): a cell's 64 pixels row by row, then "no keypoint"."""
        logits: Tensor = self.convPb(torch.relu_(self.convPa(features)))
        return logits

    def descriptor_field(self, features: Tensor) -> Tensor:
        """Return the descriptor head's output (B, 256, h, w): a vector per cell, of any length."""
        field: Tensor = self.convDb(torch.relu_(self.convDa(features)))
        return field

    def select_keypoints(self, scores: Tensor) -> tuple[Tensor, Tensor]:
        """Select points (K, 2) and scores (K,) of one suppressed score map (8h, 8w).

        Points are float32, (x, y) in pixels.
        """
        height, width = scores.shape
        # The margin of the map, not of the image. It is cut after the suppression, so a point in it
        # may suppress an inner one. A negative end would count from the other side.
        inner = scores[BORDER : max(height - BORDER, 0), BORDER : max(width - BORDER, 0)]
        rows, columns = torch.nonzero(inner > self.keypoint_threshold, as_tuple=True)
        kept = inner[rows, columns]
        points = torch.stack([columns + BORDER, rows + BORDER], dim=1).float()
        if 0 <= self.max_keypoints < len(kept):
            kept, strongest = kept.topk(self.max_keypoints)
            points = points[strongest]
        return points, kept


def score_map(logits: Tensor) -> Tensor:
    """Return the score of each pixel, (B, 8h, 8w) float32, from logits (B, 65, h, w)."""
    batch, _, h, w = logits.shape
    shares = logits.permute(0, 2, 3, 1).float().softmax(dim=3)
    cells = shares[..., :-1]  # (B, h, w, 64), without "no keypoint"
    rows = cells.reshape(batch, h, w, CELL, CELL).transpose(2, 3)  # (B, h, 8, w, 8)
    return rows.reshape(batch, CELL * h, CELL * w)


def suppress_non_maxima(scores: Tensor, radius: int) -> Tensor:
    """Set non-negative ``scores`` (B, H, W) to 0 except the maxima of their square windows.

    All equal maxima in one window are kept. Two rounds recover points that only suppressed points
    exceed. The result is neither that of greedy suppression nor its fixed point.
    """
    kept = scores == window_maximum(scores, radius)
    for _ in range(SUPPRESSION_ROUNDS):
        near = window_maximum(kept.float(), radius) > 0
        rest = scores.masked_fill(near, 0)
        kept |= (rest == window_maximum(rest, radius)) & ~near
    return scores.masked_fill(~kept, 0)


def window_maximum(values: Tensor, radius: int) -> Tensor:
    """Return the maximum over (2 radius + 1)^2 pixels around each of ``values`` (B, H, W)."""
    # Axis by axis: 2 (2 radius + 1) comparisons per pixel, not the square.
    window = 2 * radius + 1
    maps = values[:, None]
    columns = functional.max_pool2d(maps, (window, 1), 1, (radius, 0))
    both = functional.max_pool2d(columns, (1, window), 1, (0, radius))
    return both[:, 0]


def sample_descriptors(field: Tensor, points: Tensor) -> Tensor:
    """Return unit descriptors (K, D) float32 at ``points`` (K, 2), from cells ``field`` (D, h, w).

    The centre of cell j is at pixel 8 j + 3.5. The divisor below shifts a point by up to half a
    cell, as in SuperGlue's training. Cells beyond the field are zero.
    """
    h, w = field.shape[1:]
    # The last cell's centre is at 8 w - 4.5, so the distance between the outer centres would be
    # 8 w - 8. The published code divides by 8 w - 4.5; the weights were evaluated with it.
    extent = points.new_tensor([CELL * w - 4.5, CELL * h - 4.5])
    # (K, 2): -1 is the first cell's centre, 1 the last one's.
    grid = (points - 3.5) / extent * 2 - 1
    cells = functional.normalize(field.float(), dim=0)
    sampled = functional.grid_sample(
        cells[None], grid[None, None], mode="bilinear", align_corners=True
    )  # (1, D, 1, K)
    return functional.normalize(sampled[0, :, 0].T, dim=1)
