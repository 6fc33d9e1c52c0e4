"""Pictures for matchers, and comparisons of matches."""

from math import ceil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from sklearn.datasets import load_sample_image

from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import Picture
from tests.support.standin import scene


def picture(
    height: int,
    width: int,
    name: str = "scene",
    *,
    channels: int = 3,
    multiple: int = 1,
    padding: tuple[int, int] = (0, 0),
) -> Picture:
    """The scene of that name, one to one, with at least that padding on the right and at the
    bottom.
    """
    pixels = scene(height, width, channels, name)
    return as_picture(pixels if channels == 3 else pixels[..., 0], multiple, padding)


def as_picture(
    pixels: np.ndarray, multiple: int = 1, padding: tuple[int, int] = (0, 0)
) -> Picture:
    height, width = pixels.shape[:2]
    content = Size(width, height)
    sides = []
    for side, more in zip(content, padding, strict=True):
        multiples = ceil((side + more) / multiple)
        sides.append(multiples * multiple)
    view = View(Box.whole(content), content, Size(*sides))
    shown = view.render(np.ascontiguousarray(pixels))
    return Picture(shown, view)


def match_one(matcher: Any, first: Picture, second: Picture) -> Matches:
    (matches,) = matcher.match(matcher.encode([first]), matcher.encode([second]))
    return matches


def same(first: Matches, second: Matches) -> bool:
    parts = ("points0", "points1", "scores")
    return all(
        getattr(first, part).tobytes() == getattr(second, part).tobytes() for part in parts
    )


def agreement(
    first: torch.Tensor, second: torch.Tensor, within: float, p: float = 2.0
) -> float:
    """The share of the rows of either that lie within that distance of a row of the other.

    Both directions count: a matcher with a few right matches, or with many more, does not agree.
    """
    if not len(first) and not len(second):
        return 1.0
    near = torch.cdist(first, second, p=p) <= within
    count = near.any(1).sum() + near.any(0).sum()
    return (count / (len(first) + len(second))).item()


def write_two_views(directory: Path) -> None:
    """Write a.jpg and b.jpg: two parts of a photograph, 40 pixels apart; and a folder of three parts."""
    photograph = load_sample_image("china.jpg")[..., ::-1]
    (directory / "photographs").mkdir()
    parts = [
        ("a.jpg", 0),
        ("b.jpg", 40),
        *((f"photographs/{n}.jpg", 20 * n) for n in range(3)),
    ]
    for name, shift in parts:
        # A strip, because RootSIFT enlarges a view to 1,536 pixels.
        part = photograph[120:220, 60 + shift : 420 + shift]
        assert cv2.imwrite(str(directory / name), part)
