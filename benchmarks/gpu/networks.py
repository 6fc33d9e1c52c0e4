"""Every network with seeded weights: the device against the CPU, half precision, and minibatches.

The pictures are textures and their shifted copies, on which stand-in weights find matches. Agreement
is the share of matches, of either side, that lie within a distance of a match of the other side.

Dense networks draw their matches at random: each device has its own random numbers, and the last bit
of one certainty changes the whole sample. So all pixels of their warps are compared instead. Two agree
if their points lie within the distance and their certainties within ``SAME_CERTAINTY``.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from benchmarks.gpu.record import EXPECTED, Part
from benchmarks.gpu.seeded import SeededWeights
from benchmarks.gpu.setup import Setup
from mkpc_kaggle.config import from_table
from mkpc_kaggle.geometry.coordinates import Box, Size, View, from_normalised
from mkpc_kaggle.matchers.adapters import roma
from mkpc_kaggle.matchers.contract import Colour, Matcher, Picture, Placement, Precision
from mkpc_kaggle.matchers.dense import DenseEncoding, DenseMatcher
from mkpc_kaggle.matchers.dtypes import exact_float32
from mkpc_kaggle.matchers.registry import load_matcher, spec_of
from tests.support.pictures import agreement
from tests.support.standin import narrow_roma, scene

SIZE = Size(320, 224)  # multiples of 32, so that no picture is padded
QUICK_SIZE = Size(96, 64)
SHIFT = 8  # pixels between the two pictures of a pair
PAIRS = 8  # of a minibatch
QUICK_PAIRS = 2
SAME_PX = 0.05  # rounding of float32 moves points less
HALF_PX = 0.25
SAME_CERTAINTY = 0.01
SAME = 0.98  # the agreement of equal arithmetic: a match at a threshold may come or go

# All layers, all keypoints, all matches: what untrained weights would leave out is chance.
EVERY = {"depth_confidence": -1.0, "width_confidence": -1.0, "filter_threshold": 0.0}
OPTIONS: dict[str, dict[str, Any]] = {
    "superglue": {"max_keypoints": 512},
    "superpoint_lightglue": {"features": 512, **EVERY},
    "aliked": {"features": 512},
    "aliked_lightglue": {"features": 512, **EVERY},
    "sift_lightglue": {"features": 512, **EVERY},
    "disk_lightglue": {"features": 512, **EVERY},
    "xfeat_lighterglue": {"features": 512, **EVERY},
    "loma": {"variant": "b128", "max_keypoints": 512, "threshold": 0.0},
    "loftr": {},
    "quadtree": {},
    "aspanformer": {},
    "dkm": {"matches": 500},
    "roma": {"matches": 500},
}
QUICK = ("superglue", "aliked_lightglue", "loftr", "roma")
CERTAINTY = 4  # the column of a warp's certainty, after its points
LAYERS = 2  # of LightGlue: untrained layers move all keypoints' features towards each other


def measure(part: Part, setup: Setup) -> None:
    """Add a row for each network."""
    for name in QUICK if setup.quick else OPTIONS:
        part.check_time(needed=5.0 if setup.is_gpu else 0.0)
        with part.row(network=name) as row:
            row.update(_compare(name, setup))


def _compare(name: str, setup: Setup) -> dict[str, Any]:
    """Return the agreement of one network's matches, by what changed."""
    exact = _load(name, setup.device)
    colour = exact.spec.colour
    on_cpu = _points(_load(name, "cpu"), colour, setup)
    found = _points(exact, colour, setup)
    row: dict[str, Any] = {"matches": sum(map(len, on_cpu))}
    row["device and CPU"] = _agreement(found, on_cpu, SAME_PX)
    minibatch = _points(exact, colour, setup, at_a_time=QUICK_PAIRS if setup.quick else PAIRS)
    row["minibatch and 1"] = _agreement(minibatch, found, SAME_PX)
    # A grey level is the noise that every photograph has: a measure for the change by rounding.
    row["noise"] = _agreement(_points(exact, colour, setup, noise=1), found, HALF_PX)
    del exact
    worst = 1.0
    for precision in (Precision.FLOAT16, Precision.BFLOAT16):
        half = _points(_load(name, setup.device, precision), colour, setup)
        row[str(precision)] = _agreement(half, found, HALF_PX)
        worst = min(worst, row[str(precision)])
    row["verdict"] = _verdict(row, worst)
    return row


def _verdict(row: dict[str, Any], half: float) -> str:
    if not row["matches"]:
        return "no matches to compare"
    faults = [
        f"{name} differ" for name in ("device and CPU", "minibatch and 1") if row[name] < SAME
    ]
    if half < min(row["noise"], SAME):
        faults.append("half precision changes more than noise")
    return "; ".join(faults) or EXPECTED


def _load(name: str, device: str, precision: Precision = Precision.FLOAT32) -> Matcher[Any]:
    """Load a matcher with seeded weights, as a run loads it with files."""
    kind: Any = spec_of(name, "benchmark").options
    options = from_table(kind, OPTIONS[name], name)
    weights = SeededWeights(layers=LAYERS, narrow=True)
    with _for_seeded_weights(name):
        return load_matcher(name, weights, options, Placement(device, precision))


@contextmanager
def _for_seeded_weights(name: str) -> Iterator[None]:
    """Use the narrow RoMa, and let XFeat detect at any score: it was never trained."""
    if name == "roma":
        with patch.object(roma, "RoMa", narrow_roma):
            yield
    elif name == "xfeat_lighterglue":
        from mkpc_kaggle.matchers.adapters import xfeat_lighterglue

        make = xfeat_lighterglue.xfeat_network

        def lenient(features: int) -> Any:
            network = make(features)
            network.detection_threshold = 0.0
            return network

        with patch.object(xfeat_lighterglue, "xfeat_network", lenient):
            yield
    else:
        yield


def _points(
    matcher: Matcher[Any], colour: Colour, setup: Setup, *, at_a_time: int = 1, noise: int = 0
) -> list[Tensor]:
    """Return the points (M, 4) of each pair: x and y in both pictures.

    Of a dense matcher, return all pixels of both warps with their certainties (M, 5).
    """
    count = QUICK_PAIRS if setup.quick else PAIRS
    points = []
    for start in range(0, count, at_a_time):
        numbers = range(start, min(count, start + at_a_time))
        sides = []
        for shift in (SHIFT, 0):
            sides.append(
                [_picture(colour, number, shift, noise, setup) for number in numbers]
            )
        with exact_float32():
            encodings = [matcher.encode(pictures) for pictures in sides]
            if isinstance(matcher, DenseMatcher):
                points += [_warp(matcher, *both) for both in zip(*encodings, strict=True)]
                continue
            found = matcher.match(*encodings)
        points += [
            torch.from_numpy(np.hstack([each.points0, each.points1])) for each in found
        ]
    return points


def _warp(matcher: DenseMatcher, first: DenseEncoding, second: DenseEncoding) -> Tensor:
    warp, certainty = matcher.candidates(first, second)
    values = warp.cpu().numpy()
    points0 = from_normalised(values[:, :2], first.content)
    points1 = from_normalised(values[:, 2:], second.content)
    rows = np.column_stack([points0, points1, certainty.cpu().numpy()])
    return torch.from_numpy(rows)


def _picture(colour: Colour, number: int, shift: int, noise: int, setup: Setup) -> Picture:
    """Return a part of the texture of that number, which begins ``shift`` pixels further right."""
    size = QUICK_SIZE if setup.quick else SIZE
    channels = 1 if colour is Colour.GRAY else 3
    texture = scene(size.height, size.width + SHIFT, channels, f"picture {number}")
    pixels = texture[:, shift:][:, : size.width]
    change = np.random.default_rng(0).integers(-noise, noise + 1, pixels.shape)
    pixels = (pixels + change).clip(0, 255).astype(np.uint8)
    shown = np.ascontiguousarray(pixels[..., 0] if colour is Colour.GRAY else pixels)
    return Picture(shown, View(Box.whole(size), size, size))


def _agreement(first: Sequence[Tensor], second: Sequence[Tensor], within: float) -> float:
    """Return the mean agreement of pairs."""
    shares = []
    for one, other in zip(first, second, strict=True):
        if one.shape[1] > CERTAINTY:
            shares.append(_warp_agreement(one, other, within))
        else:
            shares.append(agreement(one, other, within, torch.inf))
    return round(sum(shares) / len(shares), 4)


def _warp_agreement(first: Tensor, second: Tensor, within: float) -> float:
    """Return the share of pixels whose points and certainties agree, on warps of the same grids."""
    change = (first - second).abs()
    is_near = (change[:, :CERTAINTY] <= within).all(1)
    is_as_certain = change[:, CERTAINTY] <= SAME_CERTAINTY
    return (is_near & is_as_certain).double().mean().item()
