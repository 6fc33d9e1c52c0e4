"""Pinholes in place of cameras with distortion, for programs that know no other ones.

pycolmap chooses the pinhole, so that every pixel of the new picture is one of the photograph. It
would read neither WebP nor AVIF, so the pixels are OpenCV's.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.geometry.coordinates import Pixels, Size
from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.geometry.undistortion import undistorted

# Names that OpenCV has no writer for; the content of the others is as their name.
WRITTEN_AS = {".jfif": ".jpg"}
JPEG_QUALITY = 98


def undistort(model: Any, photographs: Path, folder: Path) -> None:
    """Give the images of pycolmap's model pinholes, and write their pictures without distortion to
    ``folder``.

    Images with a pinhole keep it, and get no picture. An image of several models gets the picture of the first.
    Raises ``OSError`` if writing fails.
    """
    pinholes = {}
    # The mapper leaves cameras of images that it has given up, with focal lengths below zero.
    used = {image.camera_id for image in model.images.values()}
    for number in sorted(used):
        camera = model.cameras[number]
        if any(given_lens(camera).distortion):
            pinholes[number] = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    for _, image in sorted(model.images.items()):
        if image.camera_id not in pinholes:
            continue
        camera = model.cameras[image.camera_id]
        pinhole = pinholes[image.camera_id]
        seen = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        rays = np.column_stack([camera.cam_from_img(seen), np.ones(len(seen))])
        for point, pixel in zip(image.points2D, pinhole.img_from_cam(rays), strict=True):
            point.xy = pixel
        path = folder / image.name
        picture = read_image(photographs / image.name)
        if isinstance(picture, Image) and not path.exists():
            size = Size(pinhole.width, pinhole.height)
            pixels = undistorted(picture.pixels, given_lens(camera), given_lens(pinhole), size)
            path.write_bytes(encoded(pixels, path.suffix.lower()))
    for number, pinhole in pinholes.items():
        model.cameras[number].model = pinhole.model
        model.cameras[number].params = pinhole.params
        model.cameras[number].width = pinhole.width
        model.cameras[number].height = pinhole.height


def given_lens(camera: Any) -> KnownCamera:
    return KnownCamera(camera.model_name, tuple(float(value) for value in camera.params))


def encoded(pixels: Pixels, suffix: str) -> bytes:
    """Return the file of RGB pixels (H, W, 3) in the format of a suffix."""
    bgr = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    form = WRITTEN_AS.get(suffix, suffix)
    _, data = cv2.imencode(form, bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()
