"""A gallery: pictures on four walls, some of them hung twice, partitions and plinths in the room."""

import numpy as np

from mkpc_kaggle.demo import materials as m
from mkpc_kaggle.demo import photographs as p
from mkpc_kaggle.demo.scene import Scene, Shot, take
from mkpc_kaggle.demo.surface import Surface, box, slab, wall
from mkpc_kaggle.demo.texture import Texture, mipmap

_WIDTH, _DEPTH, _HEIGHT = 14.0, 11.0, 4.2

_NO_SKY = mipmap(np.zeros((8, 8, 3), dtype=np.uint8))  # the room is closed

_SHOTS = (
    Shot((4.0, 1.0, 1.6), (6.0, 11.0, 1.9), 0.62, (800, 600)),
    Shot((8.5, 1.4, 1.6), (5.5, 11.0, 1.9), 0.70, (800, 533), -5),
    Shot((11.5, 3.0, 1.7), (4.0, 10.0, 1.7), 0.80, (600, 800), 8),
    Shot((5.5, 3.5, 1.9), (4.2, 11.0, 1.9), 1.2, (800, 600), 17),
    Shot((1.5, 2.5, 1.5), (9.0, 10.5, 1.7), 0.80, (800, 600), -3),
    Shot((7.5, 2.2, 2.4), (10.0, 11.0, 1.8), 1.3, (600, 800), -24),
    Shot((2.0, 6.0, 1.6), (13.0, 8.5, 1.7), 0.75, (800, 600), 4),
)


def gallery(rng: np.random.Generator, photographs: p.Photographs) -> Scene:
    """In metres: the room is 14 x 11 x 4.2 with its south-western corner at the origin."""
    return Scene("gallery", 1.0, _surfaces(rng, photographs), _NO_SKY, take(rng, _SHOTS, photographs))


def _surfaces(rng: np.random.Generator, photographs: p.Photographs) -> tuple[Surface, ...]:
    parquet = mipmap(m.masonry(rng, (1536, 1536), (192, 32), (70, 110, 160), spread=0.18, joint=2))
    panels = mipmap(m.masonry(rng, (512, 512), (128, 128), (205, 210, 212), spread=0.03))
    paint = [
        mipmap(m.plaster(rng, (1536, 512), colour))
        for colour in ((185, 200, 205), (150, 140, 110), (120, 140, 175), (175, 190, 170))
    ]
    plinth = mipmap(m.masonry(rng, (256, 384), (86, 64), (170, 172, 175)))
    exhibit = mipmap(m.collage(rng, photographs, (512, 512), 2, 2))
    w, d, h = _WIDTH, _DEPTH, _HEIGHT
    partition = mipmap(m.collage(rng, photographs, (1024, 768), 4, 3))
    screen = mipmap(m.with_posters(rng, photographs, m.plaster(rng, (768, 768), (90, 100, 150)), 9, 0.3))
    return (
        slab((0, 0), (w, d), 0.0, parquet, (4, 3)),
        slab((0, 0), (w, d), h, panels, (7, 5.5)),
        wall((0, d), (w, d), 0, h, paint[0]),
        wall((w, d), (w, 0), 0, h, paint[1]),
        wall((w, 0), (0, 0), 0, h, paint[2]),
        wall((0, 0), (0, d), 0, h, paint[3]),
        *_hung(rng, photographs),
        *box((9.6, 7.6), (2.6, 0.25, 2.6), (partition, plinth), plinth, yaw=-28),
        *box((2.6, 7.8), (1.8, 0.2, 2.3), (screen, plinth), plinth, yaw=24),
        *(
            face
            for i, (x, y) in enumerate([(5.2, 6.4), (7.4, 5.6), (6.6, 8.4)])
            for face in _stand(x, y, 20 + 31 * i, plinth, exhibit)
        ),
    )


def _stand(x: float, y: float, yaw: float, plinth: Texture, exhibit: Texture) -> tuple[Surface, ...]:
    """An exhibit on a plinth."""
    return (
        *box((x, y), (0.6, 0.6, 0.95), (plinth,), plinth, yaw=yaw),
        *box((x, y), (0.42, 0.42, 0.55), (exhibit,), exhibit, yaw=yaw + 25, base=0.95),
    )


def _hung(rng: np.random.Generator, photographs: p.Photographs) -> list[Surface]:
    """Pictures in frames, some centimetres off the wall; three of the north wall come again on the east."""
    pagoda = p.crop(photographs.china, p.PAGODA, (640, 768))
    dahlia = p.crop(photographs.flower, p.DAHLIA, (640, 640))
    lake = p.crop(photographs.china, (0, 0, 640, 427), (1024, 683))
    cuts = [p.random_cut(rng, photographs, (512, 400)) for _ in range(5)]
    frames = [
        mipmap(m.framed(m.weathered(rng, painting, 0.04), 24, (40, 70, 100)))
        for painting in (pagoda, lake, dahlia, *cuts)
    ]
    north = [
        (1.5, 1.3, 1.6),
        (4.1, 2.2, 1.5),
        (6.5, 1.4, 1.4),
        (8.4, 1.5, 1.15),
        (10.4, 1.5, 1.2),
        (12.4, 1.6, 1.3),
    ]
    hung = []
    for i, (x, width, height) in enumerate(north):
        low = 1.75 - height / 2 + float(rng.uniform(-0.1, 0.1))
        hung.append(
            wall((x - width / 2, _DEPTH - 0.06), (x + width / 2, _DEPTH - 0.06), low, low + height, frames[i])
        )
    for i, (y, texture) in enumerate([(9.3, frames[3]), (7.0, frames[2]), (4.6, frames[6]), (2.0, frames[0])]):
        low = 1.0 + 0.1 * i
        hung.append(wall((_WIDTH - 0.06, y + 0.75), (_WIDTH - 0.06, y - 0.75), low, low + 1.4, texture))
    hung += [
        wall((0.06, y - 0.7), (0.06, y + 0.7), 1.0, 2.4, frames[i]) for i, y in ((4, 3.0), (7, 5.6), (5, 8.6))
    ]
    return hung
