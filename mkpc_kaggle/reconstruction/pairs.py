"""The pairs of a folder: all of up to 200 photographs; of more, each with the most similar ones."""

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import combinations
from pathlib import Path

from mkpc_kaggle.cores import available_cores
from mkpc_kaggle.data.images import file_state
from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.reconstruction.folder import Ends
from mkpc_kaggle.reconstruction.process import Child
from mkpc_kaggle.scene.likeness import local_features, shortlist

MAX_IMAGES = 200  # with more, each image has a shortlist instead of all pairs


def choose_pairs(files: Sequence[Path], work: Path, ends: float) -> list[Ends]:
    """Return the pairs to match: all, or those of a shortlist, which a file in ``work`` keeps.

    Raises :class:`UserError` if the images cannot be compared until ``ends`` on the monotonic clock.
    """
    if len(files) <= MAX_IMAGES:
        return list(combinations(files, 2))
    path = work / "shortlist.json"
    key = [[str(file), *file_state(file)] for file in files]
    kept = None
    with suppress(OSError, ValueError):  # a first run
        kept = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(kept, dict) or kept.get("files") != key:
        child = Child(_compare, list(files))
        try:
            kept = {"files": key, "pairs": child.next(ends)}
        except UserError as error:
            raise UserError(
                f"the images were not compared: {error}; name pairs by --pairs"
            ) from error
        finally:
            child.kill()
        with writing(str(path)), replacing(path) as stream:
            json.dump(kept, stream)
    return [(files[first], files[second]) for first, second in kept["pairs"]]


def _compare(files: Sequence[Path]) -> Iterator[list[tuple[int, int]]]:
    # OpenCV works without the interpreter's lock.
    with ThreadPoolExecutor(available_cores()) as pool:
        yield shortlist(list(pool.map(local_features, files)))
