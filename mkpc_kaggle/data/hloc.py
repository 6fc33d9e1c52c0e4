"""Keypoints and matches as one HDF5 file in the layout of hloc's features and matches.

The group of an image's name has ``keypoints`` (K, 2) and ``image_size`` (2,). The group NAME0/NAME1
of a pair, with "-" for each "/" in a name, has ``matches0`` (K0,): the keypoint of image 1 for each
of image 0, or -1; and ``matching_scores0`` (K0,). Pixel centres are at integers, as here.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Points, Size

SUFFIX = ".h5"


@dataclass(frozen=True, eq=False)
class HlocPair:
    """The matches of two images: rows (M, 2) of their keypoints, and scores (M,)."""

    name0: str
    name1: str
    indices: NDArray[np.int64]
    scores: NDArray[np.float32]


def require_h5py() -> Any:
    """Return the module h5py. Raise :class:`UserError` without it."""
    try:
        import h5py
    except ImportError as error:
        raise UserError("files for hloc need h5py: pip install 'mkpc-kaggle[h5]'") from error
    return h5py


def write_hloc(
    path: Path,
    keypoints: Mapping[str, Points],
    sizes: Mapping[str, Size],
    pairs: Iterable[HlocPair],
) -> None:
    """Write the keypoints of images by name, and the matches of pairs of them.

    Of several matches of a keypoint of image 0, the one with the highest score counts. Raises
    ``OSError`` if writing fails.
    """
    h5py = require_h5py()
    data = BytesIO()
    with h5py.File(data, "w") as file:
        for name, points in keypoints.items():
            group = file.require_group(name)
            group["keypoints"] = np.asarray(points, np.float32)
            if name in sizes:
                group["image_size"] = np.array(sizes[name])
        for pair in pairs:
            count = len(keypoints[pair.name0])
            matches = np.full(count, -1, np.int32)
            scores = np.zeros(count, np.float16)
            # The highest score is written last.
            for row in np.argsort(pair.scores, kind="stable"):
                first, second = pair.indices[row]
                matches[first] = second
                scores[first] = pair.scores[row]
            ends = [name.replace("/", "-") for name in (pair.name0, pair.name1)]
            group = file.require_group("/".join(ends))
            group["matches0"] = matches
            group["matching_scores0"] = scores
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as stream:
        stream.buffer.write(data.getvalue())
