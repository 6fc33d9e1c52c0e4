"""Arguments of the Python API, in the types that programs have them.

Each function returns the checked value, or raises before any work: ``TypeError`` for a wrong type,
``ValueError`` for a wrong value. The message names the argument, the value and the expected one.
"""

import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

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
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.geometry.coordinates import Matrix3, Pixels

if TYPE_CHECKING:
    import torch

ImageSource: TypeAlias = (
    "str | os.PathLike[str] | Image | NDArray[Any] | PIL.Image.Image | torch.Tensor"
)
PathSource: TypeAlias = str | os.PathLike[str]
Weights: TypeAlias = PathSource | Iterable[PathSource] | Mapping[str, PathSource]
Kind = TypeVar("Kind", bound=StrEnum)

EXPECTED_IMAGE = (
    "a path, a PIL image, an array (H, W) or (H, W, 3), or a tensor (3, H, W), "
    "of uint8 or of floats in 0..1"
)
MAX_SHOWN = 60  # characters of a value in a message


def as_image(source: ImageSource, store: ImageStore | None = None, name: str = "image") -> Image:
    """Return the image of a path, an array, a PIL image or a tensor.

    Paths are decoded by ``store``, if given, which remembers them. ``name`` is the argument, for
    messages. Raises :class:`UserError` for an unreadable file.
    """
    if isinstance(source, Image):
        return source
    if isinstance(source, str | os.PathLike):
        return _of_file(Path(source), store)
    if isinstance(source, PIL.Image.Image):
        return _of_picture(source, name)
    is_tensor = _is_tensor(source)
    array = _array_of(source)
    if isinstance(array, np.ndarray):
        return Image.of_array(_pixels(array, name, channels_first=is_tensor))
    hint = ""
    if array is None:
        hint = "; cv2.imread returns None for a file that it cannot read"
    raise TypeError(f"{name} is {shown_value(array)}; expected {EXPECTED_IMAGE}{hint}")


def _of_file(path: Path, store: ImageStore | None) -> Image:
    image = read_image(path) if store is None else store.get(path)
    if isinstance(image, Unreadable):
        raise UserError(str(image))
    # The name identifies the content: a file may change between calls.
    return replace(image, name=image.version)


def _of_picture(picture: PIL.Image.Image, name: str) -> Image:
    """Return the image of PIL's stored pixels, with its EXIF, as of the file."""
    try:
        pixels = rgb_pixels(picture)
    except (OSError, ValueError) as error:  # PIL decodes on first use
        raise UserError(f"{name} cannot be decoded: {error}") from error
    image = Image.of_array(pixels)
    turns, focal = exif_facts(exif_tags(picture), image.size)
    return replace(image, turns=turns, focal=focal)


def _pixels(array: NDArray[Any], name: str, *, channels_first: bool = False) -> Pixels:
    """Return an array or tensor as uint8 (H, W, 3) or (H, W).

    ``channels_first`` decides about a shape that could be read both ways.
    """
    what = f"{name} is {array.dtype} {array.shape}"
    if array.ndim == 4 and len(array) == 1:  # a batch of one, as networks take it
        array = array[0]
    if array.ndim == 3:
        first = array.shape[0] in (1, 3)
        last = array.shape[2] in (1, 3)
        if first and (channels_first or not last):
            array = np.moveaxis(array, 0, 2)
        elif not last:
            raise ValueError(f"{what}; expected {EXPECTED_IMAGE}")
        if array.shape[2] == 1:
            array = array[..., 0]
    if array.ndim not in {2, 3} or not array.size:
        raise ValueError(f"{what}; expected {EXPECTED_IMAGE}")
    if np.issubdtype(array.dtype, np.floating):
        low, high = float(array.min()), float(array.max())
        # False for NaN.
        if not (low >= 0 and high <= 1):
            raise ValueError(
                f"{what} with values from {low:g} to {high:g}; expected floats in 0..1"
            )
        array = np.rint(array * 255).astype(np.uint8)
    if array.dtype != np.uint8:
        raise ValueError(f"{what}; expected {EXPECTED_IMAGE}")
    return array


def files_of(sources: Iterable[ImageSource]) -> tuple[str, ...]:
    """Return the absolute path of each image that was given as one; empty for others."""
    return tuple(
        str(Path(source).absolute()) if isinstance(source, str | os.PathLike) else ""
        for source in sources
    )


def intrinsics_of(intrinsics: Any) -> tuple[Matrix3, Matrix3] | None:
    """Return both camera matrices (3, 3) float64; ``None`` if the user gave none.

    They may be arrays, nested lists or tensors, apart or stacked.
    """
    if intrinsics is None:
        return None
    expected = "(K0, K1), the camera matrices (3, 3) of both images in pixels"
    matrices = []
    for number, value in enumerate(_pair_of(intrinsics, "intrinsics", expected)):
        name = f"intrinsics[{number}]"
        try:
            K = np.asarray(_array_of(value), np.float64)
        except (TypeError, ValueError) as error:
            raise TypeError(f"{name} is {shown_value(value)}; expected {expected}") from error
        if not K.ndim:  # None and numbers
            raise TypeError(f"{name} is {shown_value(value)}; expected {expected}")
        if K.shape == (1, 3, 3):  # a batch of one
            K = K[0]
        if K.shape != (3, 3):
            raise ValueError(f"{name} has the shape {K.shape}; expected {expected}")
        is_triangular = (K[1, 0], *K[2]) == (0, 0, 0, 1)
        if not np.isfinite(K).all() or min(K[0, 0], K[1, 1]) <= 0 or not is_triangular:
            raise ValueError(
                f"{name} is {K.tolist()}; expected [fx s cx; 0 fy cy; 0 0 1] with positive fx and fy"
            )
        matrices.append(K)
    return matrices[0], matrices[1]


def _pair_of(values: Any, name: str, expected: str) -> Sequence[Any]:
    """Return the two values of an argument for both images."""
    if isinstance(values, str | bytes) or not hasattr(values, "__len__"):
        raise TypeError(f"{name} is {shown_value(values)}; expected {expected}")
    if len(values) != 2:
        shape = tuple(getattr(values, "shape", ()))
        found = f"has the shape {shape}" if shape else f"has {plural(len(values), 'value')}"
        raise ValueError(f"{name} {found}; expected {expected}")
    return [values[0], values[1]]


def member_of(kind: type[Kind], value: Any, name: str) -> Kind:
    """Return a member of an enum of strings. Raise ``ValueError`` that lists its members."""
    try:
        return kind(value)
    except ValueError as error:
        known = ", ".join(map(repr, map(str, kind)))
        raise ValueError(f"{name} is {shown_value(value)}; expected {known}") from error


def device_of(device: Any) -> str:
    """Return a device as text; ``torch.device`` is accepted."""
    torch = sys.modules.get("torch")
    return str(device) if torch is not None and isinstance(device, torch.device) else device


def precision_of(precision: Any) -> str:
    """Return a precision as text; ``torch.dtype`` is accepted."""
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(precision, torch.dtype):
        return str(precision).removeprefix("torch.")
    return str(precision)


def weights_of(weights: Any) -> tuple[list[Path], dict[str, Path]]:
    """Return the directories to search, and the files that the user gives for slots."""
    expected = "a directory, several directories, or a mapping from slots to files"
    if weights is None:
        return [], {}
    if isinstance(weights, Mapping):
        return [], {slot: _path_of(file, f"weights[{slot!r}]") for slot, file in weights.items()}
    if isinstance(weights, str | os.PathLike):
        weights = [weights]
    if not isinstance(weights, Iterable):
        raise TypeError(f"weights is {shown_value(weights)}; expected {expected}")
    return [_path_of(each, f"weights[{number}]") for number, each in enumerate(weights)], {}


def _path_of(value: Any, name: str) -> Path:
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"{name} is {shown_value(value)}; expected a path")
    return Path(value)


def shown_value(value: Any) -> str:
    """Return a value with its type for a message."""
    text = " ".join(repr(value).split())
    if len(text) > MAX_SHOWN:
        text = f"{text[:MAX_SHOWN]}..."
    return text if value is None else f"{type(value).__name__} {text}"


def _is_tensor(value: Any) -> bool:
    # A program that has a tensor has imported torch.
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def _array_of(value: Any) -> Any:
    """Return a tensor as an array; anything else as it is."""
    if not _is_tensor(value):
        return value
    tensor = value.detach().cpu()
    # NumPy has no bfloat16.
    return (tensor.float() if tensor.is_floating_point() else tensor).numpy()
