"""The room of a case before anything hostile is in it: a test side, a train side, a folder of
images, a recipe.
"""

import shutil
import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from attack import REFUSED, Case, Make, prepared
from numpy.typing import NDArray

HEADER = "sample_id,batch_id,image_1_id,image_2_id\n"
TABLE = HEADER + "b1;x-y,b1,x,y\nb1;y-z,b1,y,z\n"
UNIT = '{{ stage = {}, matcher = "sift", long_side = 200, max_matches = 500 }}'
SETTINGS = "[matchers.sift]\nfeatures = 500\n"
RECIPE = f"units = [{UNIT.format(1)}, {UNIT.format(2)}]\n{SETTINGS}"
CALIBRATION = "image_id,camera_intrinsics,rotation_matrix,translation_vector\n" + "".join(
    f"{name},200 0 80 0 200 80 0 0 1,1 0 0 0 1 0 0 0 1,{shift} 0 0\n"
    for shift, name in enumerate("xyz")
)
TEXTS = {
    "D/test.csv": TABLE,
    "T/scaling_factors.csv": "scene,scaling_factor\ns,1.5\n",
    "T/s/calibration.csv": CALIBRATION,
    "T/s/pair_covisibility.csv": "pair,covisibility\nx-y,0.9\ny-z,0.8\nx-z,0.05\n",
    "sub.csv": "sample_id,fundamental_matrix\n1,1 2 3 4 5 6 7 8 9\n",
    "truth.csv": "sample_id,scene,image_1_id,image_2_id\n1,s,x,y\n",
    "pairs.txt": "0.png 1.png\n",
    "quick.toml": RECIPE,
}
SUBMIT = "submit --test-dir D --recipe quick.toml --output out/s.csv --no-report --workers 0 --time-limit 5m"
REPORTED = SUBMIT.replace(" --no-report", "")
# Views of a few pixels' difference do not show a lens.
PINHOLES = "--set scene.camera_model=SIMPLE_PINHOLE"
IMAGES_TO = f"reconstruct I --recipe quick.toml {PINHOLES} --workers 0 --time-limit 5m --out"
RECONSTRUCT = f"{IMAGES_TO} out/o"
SIDE = 160  # small: a case is a process, and there are hundreds
# Inverse depths of five bands of rows: the views are of no plane
DEPTHS = (1.0, 2.0, 3.0, 1.5, 2.5)


@cache
def picture(shift: int) -> NDArray[np.uint8]:
    """Return the view of a camera that has moved to the right.

    ``shift`` is its motion in pixels of the farthest band.
    """
    # Blobs of two sizes: without texture, no pair would have an F.
    noise = np.random.default_rng(0).integers(0, 256, (SIDE, 3 * SIDE, 3)).astype(np.float32)
    rough = sum(cv2.GaussianBlur(noise, (0, 0), width) * width for width in (1.5, 4.0))
    whole = cv2.normalize(rough, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    starts = (round(shift * depth) for depth in DEPTHS)
    bands = zip(np.split(whole, len(DEPTHS)), starts, strict=True)
    return np.concatenate([band[:, start : start + SIDE] for band, start in bands])


def encoded(suffix: str, image: NDArray[np.uint8] | None = None, *options: int) -> bytes:
    """Return the bytes of an image file; of the first view unless another is given."""
    done, data = cv2.imencode(suffix, picture(0) if image is None else image, list(options))
    assert done
    return data.tobytes()


def write_images(folder: Path, names: str = "0123", suffix: str = ".png") -> None:
    folder.mkdir(parents=True)
    for number, name in enumerate(names):
        (folder / f"{name}{suffix}").write_bytes(encoded(suffix, picture(4 * number)))


def write_template(room: Path) -> Path:
    write_images(room / "D" / "test_images" / "b1", "xyz")
    write_images(room / "T" / "s" / "images", "xyz", ".jpg")
    write_images(room / "I")
    for name in ("out", "tmp", "home"):
        (room / name).mkdir()
    for name, text in TEXTS.items():
        (room / name).write_text(text)
    return room


@cache
def finished() -> Path:
    """Return a room in which ``SUBMIT`` and ``RECONSTRUCT`` have ended, made once per process."""
    room = write_template(Path(tempfile.mkdtemp(prefix="hostile-")) / "room")
    for command in (SUBMIT, RECONSTRUCT):
        assert prepared(command, room) == 0, f"undisturbed, it failed: {command}"
    # The log of a case has only its own output.
    (room / "out" / "log").unlink()
    return room


def resumed(change: Callable[[Path], object]) -> Make:
    """Put the results of both finished commands into the room, then change it."""

    def make(room: Path) -> None:
        shutil.copytree(finished() / "out", room / "out", dirs_exist_ok=True)
        change(room)

    return make


def replaced(name: str, make: Callable[[Path], object]) -> Make:
    """Replace a file of the room by the result of ``make``."""

    def replace(room: Path) -> None:
        (room / name).parent.mkdir(parents=True, exist_ok=True)
        (room / name).unlink(missing_ok=True)
        make(room / name)

    return replace


def written(name: str, data: bytes | str) -> Make:
    return replaced(
        name, lambda path: path.write_bytes(data.encode() if isinstance(data, str) else data)
    )


def makes(
    group: str,
    command: str,
    table: Mapping[str, Make],
    statuses: tuple[int, ...] = REFUSED,
    **more: Any,
) -> list[Case]:
    """Return a case for each change of the room, by its name; ``more`` are further fields of the
    cases.
    """
    return [
        Case(group, name, command, make, statuses, **more) for name, make in table.items()
    ]


def options(
    group: str,
    command: str,
    table: Mapping[str, str],
    statuses: tuple[int, ...] = REFUSED,
    **more: Any,
) -> list[Case]:
    """Return a case for each end of the command, by its name."""
    return [
        Case(group, name, f"{command} {end}", statuses=statuses, **more)
        for name, end in table.items()
    ]
