"""A courtyard: three wings with windows, a tower in the corner, a row of pillars, a fountain."""

import numpy as np

from mkpc_kaggle.demo import materials as m
from mkpc_kaggle.demo import photographs as p
from mkpc_kaggle.demo.scene import Scene, Shot, take
from mkpc_kaggle.demo.scenes.pagoda import pagoda
from mkpc_kaggle.demo.surface import Surface, box, slab, wall
from mkpc_kaggle.demo.texture import mipmap

_SHOTS = (
    Shot((-5.0, -7.0, 1.7), (-2.0, 20.0, 4.0), 0.75, (800, 600)),
    Shot((1.5, -5.5, 1.7), (0.5, 20.0, 3.6), 0.80, (800, 533), 6),
    Shot((7.0, -2.0, 1.6), (-3.0, 20.0, 4.5), 0.85, (600, 800), -9),
    Shot((-1.0, 1.0, 3.2), (3.0, 19.0, 4.0), 1.6, (800, 600), 14),
    Shot((-9.0, 4.0, 1.7), (4.0, 20.0, 4.0), 0.95, (800, 600), -4),
    Shot((9.0, 6.0, 2.6), (-8.0, 19.0, 4.0), 1.0, (600, 800), 22),
    Shot((-8.0, -4.0, 5.0), (6.0, 18.0, 4.2), 1.6, (800, 533), -12),
)


def courtyard(rng: np.random.Generator, photographs: p.Photographs) -> Scene:
    """In metres: x to the east, y to the north wing at 20, z up from the pavement."""
    return Scene(
        "courtyard",
        1.0,
        _surfaces(rng, photographs),
        mipmap(m.sky_panorama(rng, photographs)),
        take(rng, _SHOTS, photographs),
    )


def _surfaces(rng: np.random.Generator, photographs: p.Photographs) -> tuple[Surface, ...]:
    ground = mipmap(m.masonry(rng, (1536, 1536), (128, 96), (140, 150, 158), joint=4))
    stone = m.masonry(rng, (2048, 768), (64, 32), (150, 175, 190), joint=2)
    north = m.with_posters(rng, photographs, m.windows(rng, photographs, stone, 9, 3, (205, 215, 220)), 14, 0.06)
    bricks = m.masonry(rng, (2048, 640), (40, 18), (85, 105, 165), joint=3)
    west = m.windows(rng, photographs, bricks, 11, 3, (190, 200, 200))
    painted = m.plaster(rng, (1536, 640), (150, 200, 215))
    east = m.with_posters(rng, photographs, painted, 22, 0.14)
    flank = m.weathered(rng, p.crop(photographs.china, p.FACADE, (720, 1024)), 0.1)
    pillar = mipmap(m.masonry(rng, (128, 640), (128, 80), (165, 180, 190)))
    dahlia = mipmap(m.weathered(rng, p.crop(photographs.flower, p.DAHLIA, (512, 512)), 0.08))
    basin = mipmap(m.masonry(rng, (640, 192), (80, 48), (120, 135, 140)))
    hedge = mipmap(m.weathered(rng, p.crop(photographs.china, p.TREES, (768, 384)), 0.15))
    roof = mipmap(m.masonry(rng, (512, 256), (24, 16), (60, 80, 140)))
    pillars = [box((x, 8.0), (0.8, 0.8, 4.6), (pillar,), pillar, yaw=8 * x) for x in (-8.5, -3.2, 2.6, 8.1)]
    return (
        slab((-30, -24), (30, 26), 0.0, ground, (7, 6)),
        wall((-14, 20), (14, 20), 0, 10, mipmap(north)),
        wall((-14, -14), (-14, 20), 0, 8.5, mipmap(west)),
        wall((14, 20), (14, -2), 0, 7.5, mipmap(east)),
        *pagoda(rng, photographs, (4.5, 17.6), 6.4, yaw=-5),
        *box((-9.5, 17.5), (3.0, 3.0, 5.0), (mipmap(flank), dahlia), roof, yaw=35),
        *(face for each in pillars for face in each),
        *box((-0.6, 12.5), (3.4, 3.4, 0.9), (basin,), basin, yaw=30),
        *box((-0.6, 12.5), (1.1, 1.1, 2.3), (dahlia,), dahlia, yaw=-15, base=0.9),
        *box((10.6, 12.0), (1.6, 6.0, 1.4), (hedge,), hedge),
        *box((-11.5, 9.0), (1.6, 5.0, 1.6), (hedge,), hedge, yaw=-4),
    )
