"""The interface of matchers: each picture is encoded alone, then encodings are matched in pairs.

One contract serves sparse, semi-dense and dense networks. ``encode`` does what depends on one picture
(keypoints and descriptors, or a backbone's feature maps); its results are cached, because views of whole
images are used in many pairs. ``match`` does the rest.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import StrEnum
from itertools import product
from string import Formatter
from typing import Any, Protocol, TypeVar, get_type_hints

from mkpc_kaggle.geometry.coordinates import Pixels, Size, View
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.weights import WeightStore


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
    """Where a matcher computes, "cpu" or "cuda:0", and in which precision.

    Softmax, transport, least squares and coordinates are float32 in any.
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
    """The description of a matcher, known before it is loaded.

    ``multiple``: both sides of its pictures are padded to a multiple of it. ``same_size``: both pictures of a
    pair must have one size. ``licences``: tags of its weights. ``slots``: the manifest's slots that it needs, with
    the value of an option in place of its ``{name}``. ``options``: a frozen dataclass of its settings, which a
    recipe's table ``[matchers.NAME]`` may change.
    """

    name: str
    summary: str
    options: type = NoOptions
    colour: Colour = Colour.RGB
    multiple: int = 1
    same_size: bool = False
    licences: tuple[str, ...] = ()
    slots: tuple[str, ...] = ()

    def slots_for(self, options: Any) -> tuple[str, ...]:
        """The slots of the manifest that a matcher with these options is loaded from."""
        return tuple(slot.format_map(vars(options)) for slot in self.slots)

    @property
    def every_slot(self) -> tuple[str, ...]:
        """The slots of all trainings and variants: of every choice that the options name."""
        kinds = get_type_hints(self.options)
        found: list[str] = []
        for slot in self.slots:
            names = [name for _, name, _, _ in Formatter().parse(slot) if name]
            for choice in product(*(kinds[name] for name in names)):
                found.append(slot.format_map(dict(zip(names, choice, strict=True))))
        return tuple(dict.fromkeys(found))


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
        """Encodings of pictures that have one shape; dataclasses, so that their bytes can be counted."""
        ...

    def match(self, encodings0: Sequence[Encoding], encodings1: Sequence[Encoding]) -> Sequence[Matches]:
        """The matches of each pair of encodings, in view pixels; empty is legal."""
        ...


class Loader(Protocol):
    """Builds a matcher from its weights and its options."""

    def __call__(self, weights: WeightStore, options: Any, placement: Placement) -> Matcher[Any]: ...


@dataclass(frozen=True)
class MatcherEntry:
    """A matcher that the registry knows."""

    spec: MatcherSpec
    load: Loader


@dataclass(frozen=True)
class Unusable:
    """A matcher that cannot be imported on this machine, and why."""

    name: str
    reason: str

    def __str__(self) -> str:
        return f"matcher {self.name} cannot be used here ({self.reason})"


def encoding_bytes(encoding: Any) -> int:
    """The bytes that an encoding keeps alive, nested dataclasses and tuples included.

    A tensor counts with all of its storage, of which it may show a part; a storage counts once.
    """
    return sum(dict(_allocations(encoding)).values())


def _allocations(encoding: Any) -> Iterator[tuple[int, int]]:
    """Address and bytes of the memory of each array and tensor."""
    if hasattr(encoding, "untyped_storage"):
        storage = encoding.untyped_storage()
        yield storage.data_ptr(), storage.nbytes()
    elif hasattr(encoding, "nbytes"):
        yield id(encoding), int(encoding.nbytes)
    elif is_dataclass(encoding):
        for field in fields(encoding):
            yield from _allocations(getattr(encoding, field.name))
    elif isinstance(encoding, tuple | list):
        for one in encoding:
            yield from _allocations(one)


def detached(encoding: Any) -> Any:
    """The encoding, with copies of tensors that are views of a larger storage.

    A view of one item would keep the whole batch in memory.
    """
    if hasattr(encoding, "untyped_storage"):
        return encoding.clone() if encoding.untyped_storage().nbytes() > encoding.nbytes else encoding
    if is_dataclass(encoding) and not isinstance(encoding, type):
        parts = {field.name: detached(getattr(encoding, field.name)) for field in fields(encoding) if field.init}
        return replace(encoding, **parts)
    if type(encoding) in (tuple, list):
        return type(encoding)(map(detached, encoding))
    return encoding
