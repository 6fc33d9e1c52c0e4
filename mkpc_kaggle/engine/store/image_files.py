"""Image files: the digest of each file's content, and the facts about each content.

The store remembers a file's size, time of change and digest under its name. A file is digested
again only if its size or time has changed. A fresh run of ``submit`` digests nothing: the worker
that decodes an image returns its digest.

**An image that is replaced** has another digest, so another key: its pairs and their batch's scene are computed
again, and results of these pairs with the former file are no longer
used, though the journal keeps them. The batch's other pairs have the F of the
former scene until the new one.

- Between two runs, :func:`update_digests` notices it by size and time, at the start.
- In a run, each answer has the digest of the content that its worker decoded. With a new digest, all results of
  the former content are dropped (``State.use_image``). Workers decode a changed file again, and cache encodings
  by content. If no job reads the file again, the next run notices it.

A file that is missing or unreadable, or was not read in time, keeps its former digest and results. A change that
leaves size and time as they were is not noticed.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

from mkpc_kaggle.data.images import content_digest, file_state
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.tables import ImageContent, ImageFile
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.scene.view_graph import BatchImage

HASH_THREADS = 4  # a network disk answers several reads at a time
CHECK_S = 0.2  # between checks whether the time is over


class Digests(NamedTuple):
    """The digest of each known file's content, by name; ``changed`` are the names with another
    content than stored.
    """

    by_name: dict[str, str]
    changed: set[str]


def update_digests(store: Store, files: Mapping[str, Path], is_over: Callable[[], bool]) -> Digests:
    """Digest the known files whose size or time has changed, and store the new digests."""
    stored = store.get(ImageFile, files)
    touched: dict[str, tuple[int, int]] = {}
    for name, file in stored.items():
        now = file_state(files[name])
        # A missing file keeps its results: perhaps nothing must be matched.
        if any(now) and now != file.state:
            touched[name] = now
    computed = digest_files({name: files[name] for name in touched}, is_over)
    store.put(ImageFile(name, digest, *touched[name]) for name, digest in computed.items())
    digests = {name: file.content for name, file in stored.items()}
    changed = {name for name, digest in computed.items() if digest != digests[name]}
    return Digests(digests | computed, changed)


def current_digests(
    store: Store, files: Mapping[str, Path], is_over: Callable[[], bool]
) -> dict[str, str]:
    """Return the digest of each file's content by name, without files that cannot be read.

    Stored digests of unchanged files are used, and digests of new files are stored.
    """
    stored = store.get(ImageFile, files)
    states = {name: file_state(path) for name, path in files.items()}
    current = {
        name: file.content
        for name, file in stored.items()
        if any(states[name]) and states[name] == file.state
    }
    computed = digest_files({n: path for n, path in files.items() if n not in current}, is_over)
    # Of a file that has changed, :func:`update_digests` must still find the former digest.
    new = [name for name in computed if name not in stored]
    store.put(ImageFile(name, computed[name], *states[name]) for name in new)
    return current | computed


def digest_files(files: Mapping[str, Path], is_over: Callable[[], bool]) -> dict[str, str]:
    """Return the digest of each file's content by name, without files that cannot be read."""
    # Threads, since both reading and hashing release the interpreter lock.
    pool = ThreadPoolExecutor(HASH_THREADS)
    futures = {name: pool.submit(content_digest, path) for name, path in files.items()}
    pending = set(futures.values())
    while pending and not is_over():
        _, pending = wait(pending, CHECK_S)
    # Do not wait for the threads at work: a file of many GB takes long.
    pool.shutdown(wait=False, cancel_futures=True)
    return {
        name: future.result()
        for name, future in futures.items()
        if future.done() and not future.cancelled() and not future.exception()
    }


def stored_digests(store: Store, names: Iterable[str]) -> dict[str, str]:
    """Return the stored digests of these files' contents, by name."""
    return {name: file.content for name, file in store.get(ImageFile, names).items()}


def known_images(store: Store, digests: Mapping[str, str]) -> dict[str, BatchImage]:
    """Return the images whose contents have stored facts, by name."""
    contents = store.get(ImageContent, digests.values())
    return {
        # Files with equal contents share their facts, but not their names.
        name: BatchImage(name, digest, Size(facts.width, facts.height), facts.focal)
        for name, digest in digests.items()
        if (facts := contents.get(digest)) is not None
    }


def image_rows(image: BatchImage, file: tuple[int, int]) -> list[ImageFile | ImageContent]:
    """Return the digest of an image's file, with its :func:`file_state`, and the facts about its
    content.
    """
    return [
        ImageFile(image.name, image.digest, *file),
        ImageContent(image.digest, image.size.width, image.size.height, image.focal),
    ]


def contents_of(images: Sequence[BatchImage], turns: Sequence[int]) -> str:
    """Return a text that identifies the contents of a pair's images, and their quarter turns."""
    return " ".join([*(image.digest for image in images), *map(str, turns)])
