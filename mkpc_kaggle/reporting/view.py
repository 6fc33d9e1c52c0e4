"""An interactive view of cameras and points, for ``report.html`` and for notebooks.

One part of a page, without libraries and requests: a 2D canvas, drawn by ``templates/view.js``.
Points have 16-bit coordinates and 8-bit colours, in base64.
"""

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.errors import writing
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Pixels, Size
from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.geometry.undistortion import undistorted
from mkpc_kaggle.scene.models import MAX_POINTS, RegisteredImage, SfmModel

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

MAX_PICTURES = 200  # images that are read per scene, for thumbnails and for colours of points
THUMBNAIL_PX = 320  # the longer side
JPEG_QUALITY = 70
FAR = 4.0  # half sizes of the scene; the limit of drawn points
GREY = 150  # points outside all known pictures
STEPS = 32767  # of a 16-bit coordinate
FRUSTUM_SHARE = 0.4  # size of a frustum over the distance to the nearest camera
MIN_FRUSTUM, MAX_FRUSTUM = 0.02, 0.08  # in half sizes of the scene
FRAME_HEIGHT_PX = 760  # of the view in a notebook

# The picture of an image, by its name in the scene
Reader: TypeAlias = Callable[[str], Image | None]
Colours: TypeAlias = Sequence[NDArray[np.uint8]]
Partner: TypeAlias = tuple[str, int, int]  # another image of a pair, the pair's inliers and matches
Partners: TypeAlias = Mapping[str, Sequence[Partner]]  # by name of the image


@dataclass(frozen=True)
class SceneView:
    """A page with the view of a scene, which notebooks show in a sandboxed frame."""

    page: str  # a complete HTML document

    def _repr_html_(self) -> str:
        """Return a frame with the page. Its scripts run, and have no access to the notebook."""
        style = f"width: 100%; height: {FRAME_HEIGHT_PX}px; border: 0"
        return f'<iframe sandbox="allow-scripts" style="{style}" srcdoc="{escape(self.page)}"></iframe>'

    def save(self, path: str | Path) -> None:
        """Write the page. Raises :class:`mkpc_kaggle.errors.UserError` if that fails."""
        with writing(f"the view {path}"), replacing(Path(path)) as stream:
            stream.write(self.page)


def show(models: Iterable[SfmModel], *, metres_per_unit: float | None = None) -> SceneView:
    """Return the view of models from :func:`mkpc_kaggle.reconstruct`, whose image names are paths.

    With ``metres_per_unit``, the scale of the largest model, a bar shows a length in metres.
    """
    part = view_part([*models], "the scene", read=picture_at, metres_per_unit=metres_per_unit)
    return view_of([("", part)])


def view_of(parts: Iterable[tuple[str, "Markup"]]) -> SceneView:
    """Return the view of scenes, given the title and the part of the page of each."""
    style = "body { margin: 0; padding: .5rem; background: #fff; font: 1rem/1.5 system-ui, sans-serif; }"
    title = '<meta charset="utf-8"><title>Cameras and points</title>'
    head = f"{title}\n<style>{style}</style>{style_and_script()}"
    body = "".join(f"<h3>{escape(name)}</h3>{part}" if name else part for name, part in parts)
    return SceneView(
        f'<!doctype html>\n<html lang="en"><head>{head}</head><body>{body}</body></html>'
    )


def picture_at(path: str) -> Image | None:
    """Return the image at a path, or ``None`` if it is unreadable."""
    image = read_image(Path(path))
    return image if isinstance(image, Image) else None


def style_and_script() -> "Markup":
    """Return the style and the script of views, once per page; the script starts when the page is
    complete.
    """
    from markupsafe import Markup

    style = template("view.css")
    script = template("view.js")
    # The script comes before the views, whose canvases it looks for.
    start = 'document.addEventListener("DOMContentLoaded", () => {\n'
    return Markup(f"<style>\n{style}</style>\n<script>\n{start}{script}}});\n</script>\n")


def view_part(
    models: Sequence[SfmModel],
    title: str,
    *,
    read: Reader = lambda _: None,
    partners: Partners | None = None,
    colours: Colours = (),
    metres_per_unit: float | None = None,
) -> "Markup":
    """Return the part of a page with the view of a scene's models.

    ``read`` returns pictures, which colour the points of models without ``colours``. All text is escaped.
    """
    from markupsafe import Markup

    if not any(model.images for model in models):
        return Markup("<p>No cameras.</p>")
    data = view_data(
        models, read=read, partners=partners or {}, colours=colours, metres_per_unit=metres_per_unit
    )
    part = templates().get_template("view.html")
    return Markup(part.render(data=data, title=title))


@cache
def templates() -> "Environment":
    """Return the templates of pages, which escape all values."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    # A misspelt name is an error, and not an empty place on the page.
    return Environment(
        loader=PackageLoader("mkpc_kaggle.reporting"), autoescape=True, undefined=StrictUndefined
    )


def view_data(
    models: Sequence[SfmModel],
    *,
    read: Reader,
    partners: Partners,
    colours: Colours = (),
    metres_per_unit: float | None = None,
) -> dict[str, Any]:
    """Return the data that ``view.js`` reads, as JSON values.

    ``colours`` has the colours (P, 3) of each model's points, or is empty. Each model is in its own frame: x
    right, y down, z ahead of the mean camera, and most points within 1 of the origin. Models stand side by side,
    since their relative scale and position are unknown.
    """
    pictures = _pictures(models, read)
    frames = [_Frame.of(model) for model in models]
    given: Sequence[NDArray[np.uint8] | None] = colours or [None] * len(models)
    rows = [_model(*each, pictures, partners) for each in zip(models, frames, given, strict=True)]
    metres = None
    # Models side by side have different scales, which one bar cannot measure.
    if metres_per_unit and len(models) == 1:
        metres = metres_per_unit / frames[0].scale
    return {"models": rows, "metres": metres}


@dataclass(frozen=True, eq=False)
class _Frame:
    """The similarity from a model's world to the view's: ``scale`` * axes @ (X - centre).

    ``extent`` has the half sizes of the model in the view, at most 1.
    """

    axes: NDArray[np.float64]  # (3, 3): rows right, down, ahead in the model's world
    centre: NDArray[np.float64]
    scale: float
    extent: NDArray[np.float64]

    @classmethod
    def of(cls, model: SfmModel) -> "_Frame":
        cameras = [found.camera for found in model.images]
        _, down, ahead = np.mean([camera.R for camera in cameras], axis=0)
        if np.linalg.norm(down) < 1e-6:  # cameras of all orientations have no common vertical
            down = cameras[0].R[1]
        down = down / np.linalg.norm(down)
        ahead = ahead - ahead @ down * down
        if np.linalg.norm(ahead) < 0.1:  # cameras around an object look in all directions
            ahead = cameras[0].R[2] - cameras[0].R[2] @ down * down
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        axes = np.stack([np.cross(down, ahead), down, ahead])

        # All cameras are in the view, and all points but those far from nearly all others.
        inner = np.array([camera.centre for camera in cameras]) @ axes.T
        if len(model.points):
            bounds = np.percentile(model.points @ axes.T, (3, 97), axis=0)
            inner = np.vstack([inner, bounds])
        low = inner.min(axis=0)
        high = inner.max(axis=0)
        # A single camera without points has no extent.
        size = float((high - low).max()) or 1.0
        return cls(axes, axes.T @ (low + high) / 2, 2 / size, (high - low) / size)

    def place(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self.scale * (points - self.centre) @ self.axes.T)


def _model(
    model: SfmModel,
    frame: _Frame,
    colours_of_points: NDArray[np.uint8] | None,
    pictures: Mapping[str, Pixels],
    partners: Partners,
) -> dict[str, Any]:
    points = model.points[:MAX_POINTS]
    placed = frame.place(points)
    near = np.abs(placed).max(axis=1, initial=0) < FAR
    # A model in memory, or in a journal, has no colours.
    if colours_of_points is None:
        colours_of_points = point_colours(points, model.images, pictures)
    colours = colours_of_points[:MAX_POINTS]
    # The largest coordinate has the largest step, in models of any size.
    reach = float(np.abs(placed[near]).max(initial=1e-6))
    steps = np.round(placed[near] * (STEPS / reach)).astype("<i2")
    centres = frame.place(np.array([image.camera.centre for image in model.images]))
    return {
        "count": int(near.sum()),
        "range": reach,
        "points": _base64(steps.tobytes()),
        "colours": _base64(colours[near].tobytes()),
        "extent": _rounded(frame.extent),
        "frustum": _frustum_size(centres),
        "cameras": [_camera(image, frame, pictures, partners) for image in model.images],
    }


def _camera(
    found: RegisteredImage, frame: _Frame, pictures: Mapping[str, Pixels], partners: Partners
) -> dict[str, Any]:
    camera = found.camera
    size = found.image.size
    name = found.image.name
    sigmas = found.sigmas and (found.sigmas.rotation, 100 * found.sigmas.centre, found.sigmas.focal)
    return {
        # Names in a scene are paths below the folder, or whole paths.
        "name": Path(name).name,
        "centre": _rounded(frame.place(camera.centre[None])[0]),
        "R": [_rounded(row) for row in camera.R @ frame.axes.T],
        "wide": size.width / (2 * camera.K[0, 0]),  # tangents of half the angles of view
        "high": size.height / (2 * camera.K[1, 1]),
        "pixels": [*size],
        "points": found.points,
        "sigmas": [float(f"{value:.2g}") for value in sigmas] or None,
        "pairs": [*(partners.get(name) or partners.get(Path(name).name, ()))],
        "thumbnail": _thumbnail(pictures[name]) if name in pictures else "",
    }


def point_colours(
    points: NDArray[np.float64], images: Sequence[RegisteredImage], pictures: Mapping[str, Pixels]
) -> NDArray[np.uint8]:
    """Return the colours (P, 3) of points, each from the nearest camera with the point in its
    picture.

    The nearest camera sees a point of a surface more probably than a farther one. ``pictures`` are
    by image name and may be smaller than the images.
    """
    colours = np.full((len(points), 3), GREY, np.uint8)
    nearest = np.full(len(points), np.inf)
    for found in images:
        picture = pictures.get(found.image.name)
        if picture is None:
            continue
        pixels, depths = _projected(found.camera, points)
        height, width = picture.shape[:2]
        scale = width / found.image.size.width, height / found.image.size.height
        # (0, 0) is the centre of the first pixel of the image, which the picture reduces.
        columns, rows = np.floor((pixels + 0.5) * scale).T
        inside = (depths > 0) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        distances = np.linalg.norm(points - found.camera.centre, axis=1)
        chosen = inside & (distances < nearest)
        nearest[chosen] = distances[chosen]
        colours[chosen] = picture[rows[chosen].astype(int), columns[chosen].astype(int)]
    return colours


def _projected(
    camera: Camera, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels (P, 2) and depths (P,); pixels are not finite in the camera's plane."""
    rays = points @ camera.R.T + camera.t
    homogeneous = rays @ camera.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return homogeneous[:, :2] / homogeneous[:, 2:], rays[:, 2]


def _pictures(models: Sequence[SfmModel], read: Reader) -> dict[str, Pixels]:
    """Return the readable pictures by image name, reduced to thumbnails; of many, only the first."""
    images: dict[str, RegisteredImage] = {}
    for found in (found for model in models for found in model.images):
        images.setdefault(found.image.name, found)  # of several models, the largest comes first
    pictures = {}
    for name, found in [*images.items()][:MAX_PICTURES]:
        image = read(name)
        if image is not None:
            # A small image is not enlarged.
            scale = min(1.0, THUMBNAIL_PX / max(image.size))
            reduced = cv2.resize(
                image.pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
            )
            pictures[name] = np.asarray(reduced, np.uint8)
            if found.lens is not None and found.has_distortion:
                pictures[name] = _as_pinhole(
                    pictures[name], image.size, found.lens, found.image.size
                )
    return pictures


def _as_pinhole(picture: Pixels, stored: Size, lens: KnownCamera, size: Size) -> Pixels:
    """Return a reduced picture as a pinhole with the focal length of its lens shows the world.

    ``size`` is that of the photograph. A file of another size is one of the results, without distortion already.
    """
    source = lens
    if stored != size:
        # pycolmap has moved the middle, and kept the focal length.
        x, y = lens.principal_point
        middle = (x * stored.width / size.width, y * stored.height / size.height)
        pinhole = lens.without_distortion
        source = replace(pinhole, parameters=(*pinhole.focals, *middle))
    scale = picture.shape[1] / stored.width
    shown = Size(round(scale * size.width), round(scale * size.height))
    target = lens.without_distortion.scaled(scale, scale)
    return undistorted(picture, source.scaled(scale, scale), target, shown)


def _thumbnail(pixels: Pixels) -> str:
    bgr = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return f"data:image/jpeg;base64,{_base64(data.tobytes())}"


def _frustum_size(centres: NDArray[np.float64]) -> float:
    """Return the size of frusta that neither overlap nor vanish, from the distances of neighbours."""
    if len(centres) < 2:
        return MAX_FRUSTUM
    distances = np.linalg.norm(centres[:, None] - centres, axis=2)
    np.fill_diagonal(distances, np.inf)
    # The median, because two photographs from one place would hide all frusta.
    spacing = float(np.median(distances.min(axis=1)))
    return float(np.clip(FRUSTUM_SHARE * spacing, MIN_FRUSTUM, MAX_FRUSTUM))


def _rounded(values: NDArray[np.float64]) -> list[float]:
    return [round(float(value), 6) for value in values]


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


@cache
def template(name: str) -> str:
    """Return the text of a file in ``templates/``."""
    return files("mkpc_kaggle.reporting").joinpath("templates", name).read_text(encoding="utf-8")
