"""A street: houses of unlike depth on both sides, vans and poles in front, a pagoda at the end."""

import numpy as np

from mkpc_kaggle.demo import materials as m
from mkpc_kaggle.demo import photographs as p
from mkpc_kaggle.demo.scene import Scene, Shot, take
from mkpc_kaggle.demo.scenes.pagoda import pagoda
from mkpc_kaggle.demo.surface import Surface, box, slab
from mkpc_kaggle.demo.texture import Picture, Texture, mipmap

_SHOTS = (
    Shot((-1.5, 0.0, 1.7), (0.5, 45.0, 5.0), 0.70, (800, 600)),
    Shot((3.0, 3.0, 1.7), (-2.5, 40.0, 4.5), 0.75, (800, 533), -6),
    Shot((-3.0, 9.0, 2.2), (1.5, 45.0, 5.0), 0.90, (600, 800), 9),
    Shot((2.0, 16.0, 1.7), (0.0, 46.0, 6.5), 1.5, (600, 800), -15),
    Shot((0.5, 6.0, 4.0), (-7.0, 26.0, 3.5), 1.0, (800, 600), 5),
    Shot((-2.5, 14.0, 1.6), (7.0, 32.0, 3.8), 0.85, (800, 600), -3),
    Shot((1.0, -3.0, 2.6), (0.0, 46.0, 5.0), 1.9, (800, 600), 20),
)


def street(rng: np.random.Generator, photographs: p.Photographs) -> Scene:
    """In metres: the street runs north along y between the houses at x = -7 and x = 7."""
    return Scene(
        "street",
        1.0,
        _surfaces(rng, photographs),
        mipmap(m.sky_panorama(rng, photographs)),
        take(rng, _SHOTS, photographs),
    )


def _surfaces(rng: np.random.Generator, photographs: p.Photographs) -> tuple[Surface, ...]:
    setts = mipmap(m.masonry(rng, (1536, 1536), (64, 40), (112, 114, 118), spread=0.16))
    kerb = mipmap(m.masonry(rng, (256, 2048), (64, 64), (150, 155, 160)))
    roof = mipmap(m.masonry(rng, (512, 256), (24, 16), (60, 75, 125)))
    pole = mipmap(m.plaster(rng, (64, 512), (70, 75, 70)))
    van = [
        mipmap(m.with_posters(rng, photographs, m.plaster(rng, (512, 256), c), 4, 0.4))
        for c in ((190, 190, 195), (150, 90, 50))
    ]
    flank = mipmap(m.collage(rng, photographs, (768, 768), 4, 4))
    lots = [  # side, middle along the street, front along the street, depth, height, setback
        (-1, 6, 9.0, 8, 8.0, 0.0),
        (-1, 16, 9.0, 8, 6.5, 1.4),
        (-1, 26, 9.0, 8, 9.5, 0.3),
        (-1, 37, 11.0, 8, 7.5, 1.0),
        (1, 4, 11.0, 8, 7.0, 0.6),
        (1, 15, 9.0, 8, 9.0, 0.0),
        (1, 25.5, 10.0, 8, 6.5, 1.8),
        (1, 37, 11.0, 8, 8.5, 0.4),
    ]
    houses: list[Surface] = []
    for side, y, front, depth, height, setback in lots:
        face = mipmap(_front(rng, photographs))
        centre = (side * (7 + setback + depth / 2), y)
        houses += box(centre, (depth, front, height), (flank, face), roof, yaw=float(rng.uniform(-3, 3)))
    return (
        slab((-40, -30), (40, 80), -0.02, setts, (9, 13)),
        slab((-7.4, -10), (-5.2, 46), 0.12, kerb, (1, 6)),
        slab((5.2, -10), (7.4, 46), 0.12, kerb, (1, 6)),
        *houses,
        *pagoda(rng, photographs, (0.0, 50.0), 12.0, yaw=6),
        *_parked(van),
        *(
            face
            for x, y in [(-4.8, 12), (-4.8, 24), (4.9, 18), (4.9, 30)]
            for face in box((x, y), (0.22, 0.22, 6), (pole,), pole, yaw=20)
        ),
    )


def _front(rng: np.random.Generator, photographs: p.Photographs) -> Picture:
    """A house front: plaster or bricks, windows, bills on the wall."""
    warmth, light = rng.uniform(0.6, 1.0), rng.uniform(130, 215)
    tone = (int(light * warmth**2), int(light * warmth), int(light))
    plain = (
        m.plaster(rng, (1024, 768), tone)
        if rng.random() < 0.4
        else m.masonry(rng, (1024, 768), (44, 20), tone, joint=3)
    )
    with_windows = m.windows(
        rng, photographs, plain, int(rng.integers(4, 7)), int(rng.integers(2, 5)), (200, 208, 212)
    )
    return m.with_posters(rng, photographs, with_windows, 9, 0.16)


def _parked(van: list[Texture]) -> tuple[Surface, ...]:
    """Vans along the kerbs and a kiosk."""
    return (
        *box((-4.0, 17.5), (1.9, 4.6, 2.1), (van[0],), van[0], yaw=3, base=0.25),
        *box((3.9, 23.0), (1.9, 4.8, 2.3), (van[1],), van[1], yaw=-4, base=0.25),
        *box((-3.9, 31.0), (1.9, 4.4, 1.9), (van[1],), van[1], base=0.25),
        *box((4.0, 12.0), (1.5, 1.5, 2.6), (van[0], van[1]), van[1], yaw=30),
    )
