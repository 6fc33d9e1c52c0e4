"""What a reconstruction is given: the images of a batch by content, and the matches of its pairs."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Matrix3


@dataclass(frozen=True)
class BatchImage:
    """An image of a batch: ``name`` is what pairs call it, ``digest`` that of its content, ``size`` in pixels.

    Two names with one digest are one image.
    """

    name: str
    digest: str
    size: Size


@dataclass(frozen=True, eq=False)
class BatchPair:
    """A pair of a batch by the names of its images, with its matches in full-image pixels, which may be empty.

    ``own`` is the F, (3, 3), that the pair's matches alone gave; ``None`` where they gave none. ``tracks`` are the
    matches that the scene is made of, by the names of their matchers; ``None``: all, of one matcher.
    """

    image0: str
    image1: str
    matches: Matches
    own: Matrix3 | None = None
    tracks: Mapping[str, Matches] | None = None

    def tracks_of(self, matcher: str = "") -> Matches:
        """The matches that the scene is made of, or those of one matcher among them."""
        if self.tracks is None:
            return self.matches
        return Matches.concatenate(found for name, found in self.tracks.items() if matcher in ("", name))


@dataclass(frozen=True, eq=False)
class Batch:
    """Images and pairs to reconstruct together; raises ``ValueError`` for a pair of an unknown image."""

    images: tuple[BatchImage, ...]
    pairs: tuple[BatchPair, ...]

    def __post_init__(self) -> None:
        known = {image.name for image in self.images}
        if len(known) < len(self.images):
            raise ValueError("two images of the batch have one name")
        for pair in self.pairs:
            for name in (pair.image0, pair.image1):
                if name not in known:
                    raise ValueError(f"a pair has the image {name!r}, which the batch lacks")


@dataclass(frozen=True, eq=False)
class Edge:
    """All matches between two distinct images, given by their places in a list of images, ``first < second``."""

    first: int
    second: int
    matches: Matches


def distinct_images(images: Iterable[BatchImage]) -> tuple[BatchImage, ...]:
    """The first image of every digest, in order."""
    first: dict[str, BatchImage] = {}
    for image in images:
        first.setdefault(image.digest, image)
    return tuple(first.values())


def matchers_of(batch: Batch) -> tuple[str, ...]:
    """The matchers of its pairs' tracks, by name."""
    return tuple(sorted({name for pair in batch.pairs for name in pair.tracks or ()}))


def edges_of(batch: Batch, matcher: str = "") -> tuple[Edge, ...]:
    """The batch's pairs between its distinct images, in order of the two images; of one matcher, or of all.

    Pairs of the same two images are one, whatever their order; a pair of an image with itself is left out, since
    it says nothing, and so is one without matches.
    """
    place = {image.digest: number for number, image in enumerate(distinct_images(batch.images))}
    number_of = {image.name: place[image.digest] for image in batch.images}
    parts: dict[tuple[int, int], list[Matches]] = {}
    for pair in batch.pairs:
        first, second = number_of[pair.image0], number_of[pair.image1]
        tracks = pair.tracks_of(matcher)
        if first == second or not len(tracks):
            continue
        matches = tracks if first < second else turned(tracks)
        parts.setdefault((min(first, second), max(first, second)), []).append(matches)
    return tuple(Edge(*ends, Matches.concatenate(parts[ends])) for ends in sorted(parts))


def turned(matches: Matches) -> Matches:
    """The same matches with the two images in the other order."""
    return Matches(matches.points1, matches.points0, matches.scores)
