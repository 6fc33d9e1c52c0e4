"""Keys: the digest of everything that a result was computed from, and the facts about images in them.

A result is up to date exactly if it is stored under the key that a computation today would have.
Nothing else says so. Each kind has a version of its algorithm: increase it if the same inputs give
other results. Points depend on the unit, its matcher's options, precision, weight files and packages
(:meth:`mkpc_kaggle.setup.assembly.Assembly.unit_settings`), on both images and, for crops, on earlier points.
``POINTS_VERSION`` is that of all matchers of the package. A matcher that a user gives
in Python has its own, ``MatcherSpec.version``.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Unreadable, file_state, image_facts
from mkpc_kaggle.data.masks import Masks
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.scene.view_graph import BatchImage
from mkpc_kaggle.setup.assembly import Assembly, version_of_package
from mkpc_kaggle.setup.console import Progress

# Versions of the algorithms, each in the digests of its kind. With a wrong version, old results would
# pass as today's, which no later check notices.
POINTS_VERSION = 4
ESTIMATE_VERSION = 4
SCENE_VERSION = 13

# Settings of [mkpc] that decide whether a crop is matched, and not what is found in it.
RULE = ("when", "min_scale", "min_detail")
HASH_THREADS = 4  # a network disk answers several reads at a time
CHECK_S = 0.2  # between checks whether the time is over

Images = tuple[BatchImage, BatchImage]


def digest(value: Any) -> str:
    """Return the digest of a value of JSON types, as 32 hexadecimal digits."""
    # Sorted, since the order of a TOML file's keys means nothing. Paths and enums are texts.
    return text_digest([json.dumps(value, sort_keys=True, default=str)])


def text_digest(lines: Iterable[str]) -> str:
    """Return the digest of texts without line breaks, much faster than :func:`digest`."""
    text = "\n".join(lines)
    return hashlib.blake2b(
        text.encode("utf-8", "backslashreplace"), digest_size=16
    ).hexdigest()


@dataclass(frozen=True)
class Keys:
    """The keys of a recipe's results, from digests of its settings.

    ``units`` has a digest for each unit, in the recipe's order. ``masks`` are of single images.
    """

    units: tuple[str, ...]
    mkpc: str = ""
    estimate: str = ""
    scene: str = ""
    masks: Masks = field(default_factory=Masks)

    @classmethod
    def of(cls, assembly: Assembly) -> "Keys":
        recipe = assembly.recipe
        units = [
            digest([POINTS_VERSION, assembly.unit_settings(unit)]) for unit in recipe.units
        ]
        # All settings of a table: a new setting changes the keys, which costs a rerun but no wrong result.
        magsac = asdict(recipe.magsac)
        focal = recipe.focal and asdict(recipe.focal)
        # MAGSAC comes from OpenCV, and other versions of it may give another F.
        estimate = digest([ESTIMATE_VERSION, magsac, focal, cv2.__version__])
        # The number of candidates does not change any of them.
        scene = recipe.scene and asdict(replace(recipe.scene, candidates=1))
        mkpc = asdict(recipe.mkpc)
        cameras = [[pattern, asdict(camera)] for pattern, camera in assembly.cameras]
        # The units that make tracks: a unit's points do not depend on it, but scenes do.
        tracks = [unit.name for unit in recipe.units if unit.tracks]
        mapper = version_of_package("pycolmap")  # pairs need none
        return cls(
            tuple(units),
            digest({name: value for name, value in mkpc.items() if name not in RULE}),
            estimate,
            digest([SCENE_VERSION, scene, cameras, tracks, estimate, mapper]),
            assembly.masks,
        )

    def of_points(
        self, unit: int, pair: Pair, images: Images, first: Sequence[str] = ()
    ) -> str:
        """Return the key of a unit's points on a pair.

        ``first`` are [mkpc] and the keys of the points that the pair's crops come from; empty for a unit of
        stage 1.
        """
        image0, image1 = images
        # An image without a mask has an empty digest.
        masks = [self.masks.digest(file) for file in (pair.file0, pair.file1)]
        turns = map(str, pair.turns)
        return text_digest(
            [self.units[unit], image0.digest, image1.digest, *turns, *masks, *first]
        )

    def of_estimate(self, points: Iterable[str]) -> str:
        """Return the key of a pair's estimate from its points, in the recipe's order."""
        return text_digest([self.estimate, *points])

    def of_scene(self, inputs: Sequence[Sequence[Any]]) -> str:
        """Return the key of a scene. Each input is a pair: names, digests, keys of its points and
        estimate.
        """
        # The key includes names: images with equal contents are one image of a scene, with one name.
        return digest([self.scene, inputs])


def of_candidate(scene: str, candidate: str) -> str:
    """Return the key of a batch's candidate; ``scene`` is that of the first, from all units."""
    return text_digest([scene, candidate]) if candidate else scene


def contents_of(images: Sequence[BatchImage], turns: Sequence[int]) -> str:
    """Return a text that identifies the contents of a pair's images, and their quarter turns."""
    image0, image1 = images
    return " ".join(map(str, [image0.digest, image1.digest, *turns]))


# Images


def read_images(
    store: Store,
    files: Mapping[str, Path],
    is_over: Callable[[], bool],
    progress: Progress,
) -> dict[str, BatchImage]:
    """Return digest, size and focal length of each image by name. The digest of an image that cannot be read, or
    was not reached in time, is empty.

    Stored facts of files whose size and time have not changed are used, and new ones are stored. A run reads each
    photograph once before its first job: photographs do not change during a run.
    """
    columns = "key, size, changed, digest, width, height, focal"
    states = {name: file_state(path) for name, path in files.items()}
    images = {name: BatchImage(name, "", Size(1, 1)) for name in files}
    for name, *state, content, width, height, focal in store.select("image", columns, files):
        # A missing file keeps its results: perhaps nothing must be matched.
        if states[name] in (tuple(state), (0, 0)):
            images[name] = BatchImage(name, content, Size(width, height), focal)
    new = [name for name in files if not images[name].digest]
    # Threads, since both reading and hashing release the interpreter lock.
    pool = ThreadPoolExecutor(HASH_THREADS)
    pending = {
        pool.submit(lambda name: (name, image_facts(files[name])), name) for name in new
    }
    while pending and not is_over():
        done, pending = wait(pending, CHECK_S)
        progress.count("reading", len(new) - len(pending), len(new), "image")
        rows = []
        for name, facts in (future.result() for future in done):
            if not isinstance(facts, Unreadable):
                images[name] = BatchImage(name, *facts)
                content, size, focal = facts
                rows.append((name, *states[name], content, *size, focal))
        # In parts, so that a kill loses little of it.
        store.put({"image": rows})
    # Do not wait for the threads at work: a file of many GB takes long.
    pool.shutdown(wait=False, cancel_futures=True)
    progress.close()
    return images
