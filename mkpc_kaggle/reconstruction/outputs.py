"""OUT of ``reconstruct``: COLMAP's models, a table of cameras, folders for Gaussian splatting."""

import csv
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import numpy as np

from mkpc_kaggle.data.outputs import lies_in, sync
from mkpc_kaggle.engine.store import FILE_NAME
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.reconstruction.folder import CAMERA_COLUMNS
from mkpc_kaggle.reconstruction.process import Child
from mkpc_kaggle.scene.models import DATABASE, MODELS, SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage

WORK = "work"
# In WORK: COLMAP's files of each scene by its key, and the largest model of the last complete run
SCENES, FORMER = "scenes", "former"
TABLE = "cameras.csv"
PAGE = "report.html"
IMAGES, SPARSE = "images", "sparse"  # as other programs expect them
PART = ".mkpc-new-"  # prefix of temporary folders for new files
FOLDERS = (MODELS, IMAGES, SPARSE)
RESULTS = (DATABASE, TABLE, *FOLDERS)
MIN_COMMON = 3  # cameras
MAX_MOVED = 0.05  # of the model's size: a camera that two runs place differently
STILL = 1e-9  # of the numbers of a similarity; smaller ones are rounding


def require_out(out: Path, inputs: Iterable[Path]) -> None:
    """Create ``out``. Raise :class:`UserError` unless it is empty or of an earlier run, and apart from
    all inputs.
    """
    for path in inputs:
        if lies_in(path, out) or lies_in(out, path):
            raise UserError(
                f"--out {out} contains, or lies in, the input {path}; name another folder"
            )
    with writing(f"--out {out}"):
        out.mkdir(parents=True, exist_ok=True)
        names = {path.name for path in out.iterdir() if not path.name.startswith(".")} - {
            WORK
        }
        if names and not (out / WORK / FILE_NAME).is_file():
            raise UserError(
                f"--out {out} has {min(names)}, and no run of this command made it; name an empty folder"
            )
        # A folder that cannot be written is found now, and not after hours.
        TemporaryDirectory(prefix=PART, dir=out).cleanup()
        (out / WORK).mkdir(exist_ok=True)


def remove_results(out: Path, results: Iterable[str] = RESULTS) -> None:
    """Remove results of an earlier run: today's photographs have no models."""
    with TemporaryDirectory(prefix=PART, dir=out) as name:
        for result in results:
            with suppress(FileNotFoundError):
                (out / result).replace(Path(name, result))


def keep_former(out: Path) -> None:
    """Keep the largest model of a complete run, onto which those of later runs are moved."""
    with writing(f"--out {out}"), TemporaryDirectory(prefix=PART, dir=out) as name:
        shutil.copytree(out / MODELS / "0", Path(name) / FORMER)
        replace_results(Path(name), out / WORK, [FORMER])


class Writer:
    """Writes ``out`` whenever the scene of a run has new files, in a process of its own: pycolmap may
    end a process.
    """

    def __init__(self, root: Path, out: Path) -> None:
        self._root, self._out = root, out
        self._scene = ""  # the key of the scene that is written
        self._child: Child | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._child is not None:
            self._child.kill()
            for left in self._out.glob(f"{PART}*"):  # of a process that was killed
                shutil.rmtree(left, ignore_errors=True)

    def update(self, scene: str) -> None:
        """Begin to write the files of the scene with this key."""
        folder = self._out / WORK / SCENES / scene
        if scene != self._scene:
            self.__exit__()
            self._scene = scene
            self._child = Child(write_results, self._root, self._out, folder)

    @property
    def has_scene(self) -> bool:
        return self._child is not None

    def next(self, ends: float) -> list[SfmModel]:
        """Return the next value of :func:`write_results`, until ``ends`` on the monotonic clock; no
        models without files. Raise :class:`UserError` if writing failed.
        """
        return [] if self._child is None else list(self._child.next(ends))


def write_results(root: Path, out: Path, scene: Path) -> Iterator[list[SfmModel]]:
    """Write the models of the scene to ``out``, moved onto the former model, then ``images`` and ``sparse``. Yield
    the models, and once more if all is written.

    Only whole files replace former ones. Raises ``OSError`` if writing fails.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    folders = sorted((scene / MODELS).iterdir(), key=lambda folder: int(folder.name))
    models = [pycolmap.Reconstruction(folder) for folder in folders]
    if (out / WORK / FORMER).is_dir():
        former = pycolmap.Reconstruction(out / WORK / FORMER)
        for model in models:
            align(model, former)
    found = [values_of(model) for model in models]
    with TemporaryDirectory(prefix=PART, dir=out) as name:
        made = Path(name)
        for number, model in enumerate(models):
            folder = made / MODELS / str(number)
            folder.mkdir(parents=True)
            model.write(folder)
        with (made / TABLE).open("w", newline="", encoding="utf-8") as stream:
            csv.writer(stream, lineterminator="\n").writerows(camera_rows(found))
        shutil.copy2(scene / DATABASE, made / DATABASE)
        replace_results(made, out)
        try:
            undistort(models, root, out, made)
            replace_results(made, out)
        finally:
            yield found  # last: a child waits here until the run has ended
    yield []


def align(model: Any, former: Any) -> None:
    """Move a model of pycolmap's onto the cameras that it has in common with a former one, if any."""
    import pycolmap

    common = model.find_common_reg_image_ids(former)
    if len(common) < MIN_COMMON:
        return
    centres = np.array([former.images[there].projection_center() for _, there in common])
    size = float(np.sqrt(centres.var(axis=0).sum()))
    found = pycolmap.align_reconstructions_via_proj_centers(model, former, MAX_MOVED * size)
    # Without a change, the bytes stay.
    if found is not None and np.abs(found.matrix() - np.eye(3, 4)).max() > STILL:
        model.transform(found)


def values_of(model: Any) -> SfmModel:
    """Return pycolmap's model as values. Images have no digests."""
    from mkpc_kaggle.scene.colmap import sfm_model

    named = []
    for image in images_of(model):
        size = Size(image.camera.width, image.camera.height)
        named.append((image, BatchImage(image.name, "", size)))
    return sfm_model(model, named)


def images_of(model: Any) -> list[Any]:
    """Return the registered images of pycolmap's model by name, since its containers have no order."""
    return sorted(
        (model.images[n] for n in model.reg_image_ids()), key=lambda image: image.name
    )


def camera_rows(models: Sequence[SfmModel]) -> Iterator[Sequence[object]]:
    """Yield a header and a row per image: path below the folder, model, K, R, t with X_cam = R X + t,
    the number of its points, and its camera as in a table of ``--intrinsics``.
    """
    yield "image", "model", "K", "R", "t", "points", *CAMERA_COLUMNS[1:]
    for number, model in enumerate(models):
        for found in model.images:
            lens = found.lens
            assert lens is not None
            matrices = (found.camera.K, found.camera.R, found.camera.t)
            yield (
                found.image.name,
                number,
                # Twelve digits: later ones are rounding.
                *(
                    ";".join(f"{value:.12g}" for value in matrix.ravel())
                    for matrix in matrices
                ),
                found.points,
                lens.model,
                *found.image.size,
                " ".join(f"{value:.12g}" for value in lens.parameters),
            )


def undistort(models: Sequence[Any], root: Path, out: Path, made: Path) -> None:
    """Write ``images`` and ``sparse`` of pycolmap's models to ``made``: pinholes, with colours of
    points and without folders in names, which some readers of COLMAP's files do not expect.

    Images that have a pinhole are links to the photographs, relative to ``out``.
    """
    import pycolmap

    photographs, source, target = (
        made / name for name in ("photographs", "source", "target")
    )
    for folder in (photographs, source, made / IMAGES, made / SPARSE):
        folder.mkdir()
    linked = out.resolve() / IMAGES
    files: dict[str, Path] = {}
    for number, model in enumerate(models):
        for image in images_of(model):
            file = (root / image.name).resolve()
            name = image.name.replace("/", "_")
            while files.setdefault(name, file) != file:  # of a/b.jpg and a_b.jpg
                name = f"_{name}"
            image.name = name
            if not (photographs / name).is_symlink():  # an image may be in two models
                (photographs / name).symlink_to(file)
        model.extract_colors_for_all_images(photographs)
        model.write(source)
        links = pycolmap.FileCopyType.softlink
        pycolmap.undistort_images(target, source, photographs, copy_policy=links)
        (target / SPARSE).replace(made / SPARSE / str(number))
        for path in (target / IMAGES).iterdir():
            if path.is_symlink():
                path.unlink()
                path.symlink_to(os.path.relpath(files[path.name], str(linked)))
            path.replace(made / IMAGES / path.name)
        shutil.rmtree(target)


def replace_results(made: Path, out: Path, results: Iterable[str] = RESULTS) -> None:
    """Move the results in ``made``, a temporary folder, to ``out`` once they are on the disk."""
    sync(made)
    for name in results:
        if (made / name).exists():
            if (out / name).is_dir():
                (out / name).replace(made / f"former-{name}")
            (made / name).replace(out / name)
