"""MegaDepth-1500 from the LoFTR's ``scene_info`` files, as lines of a pair list."""

import pickle
import zipfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from mkpc_kaggle.errors import UserError

MAX_ARRAY_BYTES = 1 << 28  # limit for an unpacked array of a file
# The only names that pickled arrays need. Any other name might run code.
NAMES = {"ndarray": np.ndarray, "dtype": np.dtype, "encode": lambda text, _: text.encode("latin-1")}
NAMES |= {"_reconstruct": np.empty(0).__reduce__()[0], "scalar": np.float64(0).__reduce__()[0]}


def lines_of_scene_info(file: Path) -> Iterator[str]:
    """Yield a line of :mod:`mkpc_kaggle.data.pairs` for each pair.

    A pair has two indices into ``image_paths``, ``intrinsics``, (3, 3), and ``poses``, (4, 4) world to camera.
    Raises :class:`UserError` for any other file. Executes no code of the file.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            names = ("pair_infos", "image_paths", "intrinsics", "poses")
            infos, paths, Ks, poses = (_array(archive, f"{name}.npy") for name in names)
        for (i, j), *_ in infos:
            T = np.asarray(poses[j], float) @ np.linalg.inv(np.asarray(poses[i], float))
            numbers = np.concatenate([np.ravel(matrix) for matrix in (Ks[i], Ks[j], T)])
            yield " ".join([str(paths[i]), str(paths[j]), "0 0", *(f"{number:.17g}" for number in numbers)])
    except Exception as error:  # a pickle may raise anything
        raise UserError(f"{file} is not a scene_info of MegaDepth: {error}") from error


class _Arrays(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] not in ("numpy", "_codecs") or name not in NAMES:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which no array needs")
        return NAMES[name]


def _array(archive: zipfile.ZipFile, name: str) -> Any:
    if archive.getinfo(name).file_size > MAX_ARRAY_BYTES:
        raise ValueError(f"{name} has more than {MAX_ARRAY_BYTES} bytes")
    stream = BytesIO(archive.read(name))
    try:
        return np.lib.format.read_array(stream, allow_pickle=False)
    except ValueError:  # an array of objects: its header has been read, and its pickle follows
        return _Arrays(stream).load()
