"""Scenes: static surfaces, a sky, and the views of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mkpc_kaggle.demo.camera import Camera, Floats, look_at, resized
from mkpc_kaggle.demo.photographs import Photographs, random_cut
from mkpc_kaggle.demo.render import render
from mkpc_kaggle.demo.surface import Surface, scaled, wall
from mkpc_kaggle.demo.texture import FloatImage, Texture, mipmap

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Shot:
    """One picture to take, in metres: from where, at what, `focal` in units of the image's long side."""

    position: Point
    target: Point
    focal: float
    size: tuple[int, int]
    roll: float = 0.0


@dataclass(frozen=True, eq=False)
class View:
    """A camera, the direction of light at that time, and the occluders at that time."""

    camera: Camera
    sun: Floats
    passing: tuple[Surface, ...]


@dataclass(frozen=True, eq=False)
class Scene:
    """A world, in units of `metres_per_unit` metres."""

    name: str
    metres_per_unit: float
    surfaces: tuple[Surface, ...]
    sky: Texture
    views: tuple[View, ...]

    def render(self, view: View) -> tuple[FloatImage, FloatImage]:
        """Image (H, W, 3) float32 BGR in 0..255 and depth (H, W) float32 in the scene's units."""
        return render((*self.surfaces, *view.passing), self.sky, view.camera, view.sun)


def take(rng: np.random.Generator, shots: Sequence[Shot], photographs: Photographs) -> tuple[View, ...]:
    """The views of the shots, each with a small random offset, other light and other people."""
    clutter = [mipmap(random_cut(rng, photographs, (160, 480))) for _ in range(4)]
    return tuple(_view(rng, shot, clutter) for shot in shots)


def in_units(scene: Scene, metres_per_unit: float, image_scale: float) -> Scene:
    """The scene, given in metres, in units of its own, and with images `image_scale` times as large."""
    factor = 1 / metres_per_unit

    def convert(view: View) -> View:
        camera = resized(replace(view.camera, t=view.camera.t * factor), image_scale)
        return replace(view, camera=camera, passing=tuple(scaled(s, factor) for s in view.passing))

    return replace(
        scene,
        metres_per_unit=metres_per_unit,
        surfaces=tuple(scaled(s, factor) for s in scene.surfaces),
        views=tuple(convert(view) for view in scene.views),
    )


def _view(rng: np.random.Generator, shot: Shot, clutter: Sequence[Texture]) -> View:
    width, height = shot.size
    camera = look_at(
        np.add(shot.position, rng.uniform(-0.15, 0.15, 3)),
        np.add(shot.target, rng.uniform(-0.3, 0.3, 3)),
        focal=shot.focal * max(shot.size),
        width=width,
        height=height,
        roll=shot.roll + rng.uniform(-2, 2),
    )
    sun = np.array([0.4, -0.5, 0.8]) + rng.uniform(-0.35, 0.35, 3)
    passing = tuple(_passer_by(rng, camera, clutter) for _ in range(int(rng.integers(1, 3))))
    return View(camera, sun, passing)


def _passer_by(rng: np.random.Generator, camera: Camera, clutter: Sequence[Texture]) -> Surface:
    """An upright board the size of a person near the left or the right border of the image, facing us."""
    column = rng.choice((0.12, 0.88)) + rng.uniform(-0.1, 0.1)
    x = (column * camera.width - camera.K[0, 2]) / camera.K[0, 0]
    distance = rng.uniform(4, 7) * camera.K[0, 0] / max(camera.width, camera.height)
    right, forward = camera.R[0, :2], camera.R[2, :2]
    middle = camera.centre[:2] + distance * (forward + x * right)
    half = 0.28 * right / np.linalg.norm(right)
    return wall(
        middle - half, middle + half, 0.0, float(rng.uniform(1.55, 1.9)), clutter[int(rng.integers(len(clutter)))]
    )
