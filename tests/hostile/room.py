"""The room of a case before anything hostile is in it: a test set of three small images, a quick recipe."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

HEADER = "sample_id,batch_id,image_1_id,image_2_id\n"
TABLE = HEADER + "b1;x-y,b1,x,y\nb1;y-z,b1,y,z\n"
RECIPE = """\
units = [
    { stage = 1, matcher = "sift", long_side = 200, max_matches = 500 },
    { stage = 2, matcher = "sift", long_side = 200, max_matches = 500 },
]
[matchers.sift]
features = 500
"""
SUBMIT = "submit --test-dir D --recipe quick.toml --output out/s.csv --no-report --workers 0 --time-limit 5m"
SIDE = 160


@cache
def picture(shift: int) -> NDArray[np.uint8]:
    """A view of a rough texture, so many pixels to the right."""
    noise = np.random.default_rng(0).integers(0, 256, (SIDE, 2 * SIDE, 3)).astype(np.float32)
    rough = sum(cv2.GaussianBlur(noise, (0, 0), width) * width for width in (1.5, 4.0))
    whole = cv2.normalize(rough, None, 0, 255, cv2.NORM_MINMAX)
    return np.ascontiguousarray(whole[:, shift : shift + SIDE]).astype(np.uint8)


def encoded(suffix: str, image: NDArray[np.uint8] | None = None, *options: int) -> bytes:
    """An image file's bytes; of the first image unless another is given."""
    done, data = cv2.imencode(suffix, picture(0) if image is None else image, list(options))
    assert done
    return data.tobytes()


def write_sparse(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(1 << 40)


def write_template(room: Path) -> Path:
    images = room / "D" / "test_images" / "b1"
    for folder in (images, room / "out", room / "tmp", room / "home"):
        folder.mkdir(parents=True)
    for number, name in enumerate("xyz"):
        (images / f"{name}.png").write_bytes(encoded(".png", picture(12 * number)))
    (room / "D" / "test.csv").write_text(TABLE)
    (room / "quick.toml").write_text(RECIPE)
    return room
