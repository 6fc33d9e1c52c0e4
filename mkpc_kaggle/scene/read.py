"""A batch from files: which images there are, by content, and how large they are."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

from mkpc_kaggle.data.images import Image, Unreadable, read_image
from mkpc_kaggle.scene.batch import Batch, BatchImage, BatchPair

Read = Callable[[Path], Image | Unreadable]


def batch_of(pairs: Sequence[BatchPair], read: Read = read_image) -> tuple[list[int], Batch]:
    """The batch of pairs whose images go by the paths of their files.

    Also the places of its pairs among ``pairs``: those with an image that cannot be read are left out.
    """
    names = dict.fromkeys(name for pair in pairs for name in (pair.image0, pair.image1))
    images = {name: image for name in names if (image := described(Path(name), read)) is not None}
    readable = [place for place, pair in enumerate(pairs) if {pair.image0, pair.image1} <= images.keys()]
    return readable, Batch(tuple(images.values()), tuple(pairs[place] for place in readable))


def described(path: Path, read: Read) -> BatchImage | None:
    """An image by the digest of its pixels; ``None`` where it cannot be read."""
    image = read(path)
    if not isinstance(image, Image):
        return None
    return BatchImage(str(path), hashlib.sha256(image.pixels.tobytes()).hexdigest(), image.size)
