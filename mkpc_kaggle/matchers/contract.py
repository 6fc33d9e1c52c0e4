"""The interface of matchers: each picture is encoded alone, then encodings are matched in pairs.

One contract serves sparse, semi-dense and dense networks. ``encode`` does what depends on one picture
(keypoints and descriptors, or a backbone's feature maps). Its results are cached, because views of whole
images are used in many pairs. ``match`` does the rest.
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
    """A network's values are infinite or NaN, as may happen in half precision."""


class Colour(StrEnum):
    """The format of a matcher's pictures: (H, W, 3) RGB or (H, W) gray."""

    RGB = "rgb"
    GRAY = "gray"


class Precision(StrEnum):
    """Of a network's convolutions and linear layers, by PyTorch's names."""

    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"
    FLOAT16 = "float16"


@dataclass(frozen=True)
class Placement:
    """The device of a matcher, "cpu" or "cuda:0", and its precision.

    Softmax, transport, least squares and coordinates are float32 in any precision.
    """

    device: str = "cpu"
    precision: Precision = Precision.FLOAT32

    def __str__(self) -> str:
        return f"device {self.device} in {self.precision}"


class Training(StrEnum):
    """Which of a network's published weights: trained on MegaDepth's or on ScanNet's pictures."""

    OUTDOOR = "outdoor"
    INDOOR = "indoor"


@dataclass(frozen=True)
class NoOptions:
    """For a matcher without settings."""


@dataclass(frozen=True)
class MatcherSpec:
    """The description of a matcher, known before it is loaded."""

    name: str
    summary: str
    options: type = NoOptions  # a frozen dataclass of settings, which a recipe's table [matchers.NAME] may change
    colour: Colour = Colour.RGB
    multiple: int = 1  # both sides of a picture are padded to a multiple of it
    licences: tuple[str, ...] = ()  # tags of the weights
    slots: tuple[str, ...] = ()  # the manifest's slots that it needs; ``{name}`` stands for that option's value

    def slots_for(self, options: Any) -> tuple[str, ...]:
        """Return the slots of the manifest that a matcher with these options needs."""
        return tuple(slot.format_map(vars(options)) for slot in self.slots)

    def uses(self, slot: str) -> bool:
        """Return whether any training or variant uses the slot."""
        return any(fnmatch(slot, re.sub(r"{\w+}", "*", own)) for own in self.slots)


@dataclass(frozen=True, eq=False)
class Picture:
    """A matcher's input: ``pixels`` uint8, (H, W, 3) RGB or (H, W) gray, and the view that they show.

    Only the top-left ``content`` holds the image; the rest is padding, on which no point may lie.
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
        """Encodings of pictures that have one shape.

        Their arrays are counted in dataclasses, tuples and lists. They should not be views of larger arrays: each
        encoding may be cached alone.
        """
        ...

    def match(self, encodings0: Sequence[Encoding], encodings1: Sequence[Encoding]) -> Sequence[Matches]:
        """The matches of each pair of encodings, in view pixels; empty is legal."""
        ...


class PairwiseMatcher(Generic[Encoding]):
    """A matcher that matches its pairs one after the other, so that results do not depend on the minibatch."""

    def match(self, encodings0: Sequence[Encoding], encodings1: Sequence[Encoding]) -> list[Matches]:
        import torch  # here, since it takes seconds and those who read specs need none

        with torch.inference_mode():
            return [self._match(*pair) for pair in zip(encodings0, encodings1, strict=True)]

    def _match(self, first: Encoding, second: Encoding) -> Matches:
        raise NotImplementedError


def arrays_of(value: Any) -> Iterator[Any]:
    """The arrays and tensors in a value: in nested dataclasses, tuples and lists."""
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
