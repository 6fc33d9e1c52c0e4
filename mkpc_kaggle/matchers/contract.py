"""The interface of matchers: pictures are encoded one by one, then encodings are matched in pairs.

One contract serves sparse, semi-dense and dense networks. ``encode`` computes everything that
depends on one picture alone: keypoints and descriptors, or a backbone's feature maps. Encodings of
whole images are cached, because many pairs share them. ``match`` computes the rest.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from typing import Any, Generic, Protocol, TypeVar

from mkpc_kaggle.geometry.coordinates import Pixels, Size, View
from mkpc_kaggle.geometry.matches import Matches


class NonFiniteError(ArithmeticError):
    """Infinite or NaN values in a network, such as from overflow in half precision."""


class Colour(StrEnum):
    """The format of a matcher's pictures: (H, W, 3) RGB or (H, W) gray."""

    RGB = "rgb"
    GRAY = "gray"


class Precision(StrEnum):
    """The precision of a network's convolutions and linear layers, with PyTorch's names."""

    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"
    FLOAT16 = "float16"


@dataclass(frozen=True)
class Placement:
    """A matcher's device, such as "cpu" or "cuda:0", and precision.

    Softmax, optimal transport, least squares and coordinates are always float32.
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
    """The description of a matcher, known before it is loaded.

    Parameters
    ----------
    name : str
        The matcher's name in the units of recipes.
    options : type
        A frozen dataclass; a recipe's table ``[matchers.NAME]`` sets its fields.
    colour : Colour
        The format of the pictures that the matcher gets.
    multiple : int
        The sides of pictures are padded to multiples of this.
    slots : tuple of str
        Slots of the manifest of weights; ``{name}`` stands for the value of option ``name``.
    version : str
        Of a matcher given in Python: its results are kept for later runs under this text, so
        change it whenever equal pictures get other points. Without it, results are not kept. For a
        matcher of the registry it has no effect: increase ``keys.POINTS_VERSION`` instead.
    packages : tuple of str
        Distributions whose code computes points: their versions are in the keys of results.
        "opencv" is any build of OpenCV.

    Examples
    --------
    >>> from mkpc_kaggle import Colour, MatcherSpec
    >>> MatcherSpec("orb", colour=Colour.GRAY, version="1").colour.value
    'gray'
    """

    name: str
    options: type = NoOptions
    colour: Colour = Colour.RGB
    multiple: int = 1
    slots: tuple[str, ...] = ()
    version: str = ""
    packages: tuple[str, ...] = ()

    def slots_for(self, options: Any) -> tuple[str, ...]:
        """Return the manifest's slots that a matcher with these options needs."""
        return tuple(slot.format_map(vars(options)) for slot in self.slots)


@dataclass(frozen=True, eq=False)
class Picture:
    """A matcher's input: the ``pixels`` of a ``view``, uint8, (H, W, 3) RGB or (H, W) gray.

    The image fills the top-left ``content``. The rest is padding, where a matcher must return no
    points.
    """

    pixels: Pixels
    view: View

    @property
    def content(self) -> Size:
        return self.view.content


Encoding = TypeVar("Encoding")


class Matcher(Protocol[Encoding]):
    """A loaded matcher. ``encode`` returns an item per picture, ``match`` per pair, in order."""

    @property
    def spec(self) -> MatcherSpec: ...

    def encode(self, pictures: Sequence[Picture]) -> Sequence[Encoding]:
        """Encode pictures of one shape.

        Encodings are dataclasses, tuples or lists of arrays, whose bytes the cache counts. An array
        must not be a view of a larger one, which the cache would keep in memory.
        """
        ...

    def match(
        self, encodings0: Sequence[Encoding], encodings1: Sequence[Encoding]
    ) -> Sequence[Matches]:
        """Return the matches of each pair of encodings, in view pixels. A pair may have none."""
        ...


class PairwiseMatcher(Generic[Encoding]):
    """A matcher that matches pairs one by one, so that results do not depend on the minibatch.

    A subclass defines three things: ``spec``, a :class:`MatcherSpec`; ``encode(pictures)``, which
    returns an encoding for each :class:`Picture`; and ``_match(first, second)``, which returns the
    :class:`Matches` of two encodings, in pixels of the pictures. ``docs/own_matcher.py`` is a
    template.

    Examples
    --------
    A matcher that returns a grid of identical points:

    >>> import numpy as np
    >>> from mkpc_kaggle import Matches, MatcherSpec, PairwiseMatcher, TwoStageMatcher
    >>> from mkpc_kaggle import Recipe, Unit
    >>> class Identity(PairwiseMatcher):
    ...     spec = MatcherSpec("identity")
    ...
    ...     def encode(self, pictures):
    ...         return [np.argwhere(np.ones((10, 10))) * 8.0 for picture in pictures]
    ...
    ...     def _match(self, first, second):
    ...         return Matches(first, second, np.ones(len(first)))
    >>> recipe = Recipe([Unit(1, "identity", 320)])
    >>> matcher = TwoStageMatcher(recipe, matchers={"identity": Identity()})
    >>> len(matcher("a.jpg", "a.jpg").matches)
    100
    """

    def match(
        self, encodings0: Sequence[Encoding], encodings1: Sequence[Encoding]
    ) -> list[Matches]:
        import torch  # here: the import takes seconds, and specs need no torch

        with torch.inference_mode():
            return [self._match(*pair) for pair in zip(encodings0, encodings1, strict=True)]

    def _match(self, first: Encoding, second: Encoding) -> Matches:
        raise NotImplementedError


def arrays_of(value: Any) -> Iterator[Any]:
    """Yield the arrays and tensors in nested dataclasses, dictionaries, tuples and lists."""
    # NumPy's arrays and PyTorch's tensors alike, without importing torch.
    if hasattr(value, "nbytes"):
        yield value
    elif is_dataclass(value):
        for field in fields(value):
            yield from arrays_of(getattr(value, field.name))
    elif isinstance(value, dict):
        yield from arrays_of([*value.values()])
    elif isinstance(value, tuple | list):
        for item in value:
            yield from arrays_of(item)


def encoding_bytes(encoding: Any) -> int:
    """Return the memory that an encoding's arrays take, in bytes."""
    return sum(array.nbytes for array in arrays_of(encoding))
