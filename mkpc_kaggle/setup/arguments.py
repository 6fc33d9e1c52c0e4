"""Arguments of the Python API that an assembly takes: weights, device, precision."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

PathSource: TypeAlias = str | os.PathLike[str]
Weights: TypeAlias = PathSource | Iterable[PathSource] | Mapping[str, PathSource]

MAX_SHOWN = 60  # characters of a value in a message


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
