"""The pagoda of the photograph as a stack of boxes, so that its front is no plane."""

import numpy as np

from mkpc_kaggle.demo import materials as m
from mkpc_kaggle.demo import photographs as p
from mkpc_kaggle.demo.surface import Surface, box
from mkpc_kaggle.demo.texture import mipmap


def pagoda(
    rng: np.random.Generator,
    photographs: p.Photographs,
    centre: tuple[float, float],
    width: float,
    *,
    yaw: float = 0.0,
) -> tuple[Surface, ...]:
    """Three storeys, each narrower than the one below; `width` is that of the lowest, in metres."""
    eaves = mipmap(m.masonry(rng, (512, 512), (24, 20), (60, 95, 175), joint=2))
    texels_per_metre = 900 / width
    surfaces: list[Surface] = []
    base = 0.0
    for tier, share in zip(p.TIERS, (1.0, 0.8, 0.6), strict=True):
        left, top, right, bottom = tier
        front = width * share
        height = front * (bottom - top) / (right - left)
        size = (int(front * texels_per_metre), int(height * texels_per_metre))
        faces = tuple(mipmap(m.weathered(rng, p.crop(photographs.china, tier, size), 0.07)) for _ in range(2))
        surfaces += box(centre, (front, front * 0.8, height), faces, eaves, yaw=yaw, base=base)
        base += height
    return tuple(surfaces)
