"""Arguments of the Python API: images and camera matrices, in the types that programs have them."""

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from mkpc_kaggle.data.images import (
    Image,
    ImageStore,
    Unreadable,
    exif_facts,
    exif_tags,
    read_image,
    rgb_pixels,
)
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Matrix3

if TYPE_CHECKING:
    import torch

ImageSource: TypeAlias = (
    "str | os.PathLike[str] | Image | NDArray[Any] | PIL.Image.Image | torch.Tensor"
)


def as_image(source: ImageSource, store: ImageStore | None = None) -> Image:
    """Return the image of a path, a PIL image, an array (H, W) or (H, W, 3), or a tensor (3, H, W) or (1, H, W).

    Arrays and tensors have uint8, or floats in 0..1. Paths are decoded by ``store``, if given, which
    remembers them. Raises :class:`UserError` for an unreadable file, ``ValueError`` for other values.
    """
    if isinstance(source, Image):
        return source
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        image = read_image(path) if store is None else store.get(path)
        if isinstance(image, Unreadable):
            raise UserError(str(image))
        # The name identifies the content: a file may change between calls.
        return replace(image, name=image.version)
    if isinstance(source, PIL.Image.Image):
        image = Image.of_array(rgb_pixels(source))
        turns, focal = exif_facts(exif_tags(source), image.size)
        return replace(image, turns=turns, focal=focal)
    array = _array_of(source)
    if hasattr(source, "detach") and array.ndim == 3:
        array = np.moveaxis(array, 0, 2)  # of a tensor
    if array.shape[2:] == (1,):
        array = array[..., 0]
    if np.issubdtype(array.dtype, np.floating):
        if not (array.min() >= 0 and array.max() <= 1):  # False for NaN
            raise ValueError("an image of floats must have values in 0..1")
        array = np.rint(array * 255).astype(np.uint8)
    return Image.of_array(array)


def intrinsics_of(intrinsics: Any) -> tuple[Matrix3, Matrix3]:
    """Return both camera matrices (3, 3) float64 of arrays, nested lists or tensors.

    Raises ``ValueError`` for a matrix that is not [fx s cx; 0 fy cy; 0 0 1] with positive fx and fy.
    """
    stacked = np.asarray([_array_of(K) for K in intrinsics], np.float64).reshape(2, 3, 3)
    for K in stacked:
        is_triangular = (K[1, 0], *K[2]) == (0, 0, 0, 1)
        if not np.isfinite(K).all() or min(K[0, 0], K[1, 1]) <= 0 or not is_triangular:
            raise ValueError(f"{K.tolist()} is not a camera matrix [fx s cx; 0 fy cy; 0 0 1]")
    return stacked[0], stacked[1]


def _array_of(value: Any) -> NDArray[Any]:
    """Return an array, or a tensor with or without a gradient on any device, as an array."""
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
