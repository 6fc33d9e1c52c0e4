"""The interface of matchers: pictures are encoded one by one, then encodings are matched in pairs.

One contract serves sparse, semi-dense and dense networks. ``encode`` computes all that depends on one picture
(keypoints and descriptors, or a backbone's feature maps). Its results are cached, because many pairs use the view
of a whole image. ``match`` computes the rest.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from fnmatch import fnmatch
from typing import Any, Generic, Protocol, TypeVar

from mkpc_kaggle.geometry.coordinates import Pixels, Size, View
from mkpc_kaggle.geometry.matches import Matches


class NonFiniteError(ArithmeticError):
    """Infinite or NaN values in a network, which half precision can cause."""


class Colour(StrEnum):
    """The format of a matcher's pictures: (H, W, 3) RGB or (H, W) gray."""

    RGB = "rgb"
    GRAY = "gray"


class Precision(StrEnum):
    """The precision of a network's convolutions and linear layers, by PyTorch's names."""

    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"
    FLOAT16 = "float16"


@dataclass(frozen=True)
class Placement:
    """The device of a matcher, "cpu" or "cuda:0", and its precision.

    Softmax, transport, least squares and coordinates are always float32.
    """

    device: str = "cpu"
    precision: Precision = Precision.FLOAT32

    def __str__(self) -> str:
        return f"device {self.device} in {self.precision}"


class Training(StrEnum):
    """The training set of published weights: MegaDepth (outdoor) or ScanNet (indoor)."""

    OUTDOOR = "outdoor"
    INDOOR = "indoor"


@dataclass(frozen=True)
class NoOptions:
    """The options of a matcher without settings."""


@dataclass(frozen=True)
class TrainedOptions:
    """The options of a matcher with weights for outdoors and indoors."""

    training: Training = Training.OUTDOOR


@dataclass(frozen=True)
class MatcherSpec:
    """The description of a matcher, known before it is loaded."""

    name: str
    options: type = NoOptions  # a frozen dataclass; a recipe's table [matchers.NAME] sets its fields
    colour: Colour = Colour.RGB
    multiple: int = 1  # pictures are padded to multiples of it
    slots: tuple[str, ...] = ()  # of the manifest; ``{name}`` stands for that option's value
    licences: tuple[str, ...] = ()  # tags of weights that the manifest does not list

    def slots_for(self, options: Any) -> tuple[str, ...]:
        """Return the slots of the manifest that a matcher with these options needs."""
        return tuple(slot.format_map(vars(options)) for slot in self.slots)

    def uses(self, slot: str) -> bool:
        """Return whether any training or variant uses the slot."""
        return any(fnmatch(slot, re.sub(r"{\w+}", "*", own)) for own in self.slots)


@dataclass(frozen=True, eq=False)
class Picture:
    """A matcher's input: ``pixels`` uint8, (H, W, 3) RGB or (H, W) gray, of a ``view``.

    Only the top-left ``content`` holds the image; the rest is padding, which must have no points.
    """

    pixels: Pixels
    view: View

    @property
    def content(self) -> Size:
        return self.view.content


Encoding = TypeVar("Encoding")


class Matcher(Protocol[Encoding]):
    """A loaded matcher. Both methods return one item for each input, in order."""

    @property
    def spec(self) -> MatcherSpec: ...

    def encode(self, pictures: Sequence[Picture]) -> Sequence[Encoding]:
        """Encode pictures of one shape.

        Encodings are dataclasses, tuples or lists of arrays, by which their size is counted. Arrays must not be
        views of larger arrays, since encodings are cached one by one.
        """
        ...

    def match(self, encodings0: Sequence[Encoding], encodings1: Sequence[Encoding]) -> Sequence[Matches]:
        """Return the matches of each pair of encodings, in view pixels; empty is legal."""
        ...


class PairwiseMatcher(Generic[Encoding]):
    """A matcher that matches pairs one by one, so that results do not depend on the minibatch."""

    def match(self, encodings0: Sequence[Encoding], encodings1: Sequence[Encoding]) -> list[Matches]:
        import torch  # here: the import takes seconds, and specs need no torch

        with torch.inference_mode():
            return [self._match(*pair) for pair in zip(encodings0, encodings1, strict=True)]

    def _match(self, first: Encoding, second: Encoding) -> Matches:
        raise NotImplementedError


def arrays_of(value: Any) -> Iterator[Any]:
    """Yield the arrays and tensors in nested dataclasses, tuples and lists."""
    if hasattr(value, "nbytes"):
        yield value
    elif is_dataclass(value):
        for field in fields(value):
            yield from arrays_of(getattr(value, field.name))
    elif isinstance(value, tuple | list):
        for item in value:
            yield from arrays_of(item)


def encoding_bytes(encoding: Any) -> int:
    return sum(array.nbytes for array in arrays_of(encoding))
