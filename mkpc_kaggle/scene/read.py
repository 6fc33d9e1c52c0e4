"""A batch from files: which images there are, by content, and how large they are."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from mkpc_kaggle.data.images import Image, Unreadable, read_image
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Matrix3
from mkpc_kaggle.scene.batch import Batch, BatchImage, BatchPair

Read = Callable[[Path], Image | Unreadable]


def batch_of(
    pairs: Sequence[tuple[tuple[Path, Path], Matches, Matrix3 | None, Mapping[str, Matches]]],
    read: Read = read_image,
) -> tuple[list[int], Batch]:
    """The batch of pairs, given by their images' files, matches, own F and tracks; images go by their paths.

    Also the places of its pairs among ``pairs``: those with an image that cannot be read are left out.
    """
    images = {path: described(path, read) for path in dict.fromkeys(path for paths, *_ in pairs for path in paths)}
    readable = [place for place, (paths, *_) in enumerate(pairs) if all(images[path] for path in paths)]
    chosen = [pairs[place] for place in readable]
    return readable, Batch(
        tuple(image for image in images.values() if image is not None),
        tuple(
            BatchPair(str(first), str(second), matches, own, tracks)
            for (first, second), matches, own, tracks in chosen
        ),
    )


def described(path: Path, read: Read) -> BatchImage | None:
    """An image by the digest of its pixels; ``None`` where it cannot be read."""
    image = read(path)
    if not isinstance(image, Image):
        return None
    return BatchImage(str(path), hashlib.sha256(image.pixels.tobytes()).hexdigest(), image.size)
