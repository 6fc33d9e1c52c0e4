"""Choice of the pairs of a folder: images to match with each other, and their orientations.

The orientation of an image is found by matching four rotations of the image with its most similar
images.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.console import logger
from mkpc_kaggle.engine.loop import Engine
from mkpc_kaggle.engine.request import name_below
from mkpc_kaggle.engine.session import Session, request_of
from mkpc_kaggle.engine.store.database import Source
from mkpc_kaggle.engine.store.keys import digest
from mkpc_kaggle.engine.store.tables import Feature
from mkpc_kaggle.errors import plural
from mkpc_kaggle.reconstruction.folder import Datasets, Ends, batch_names
from mkpc_kaggle.scene.likeness import (
    FEATURE_SETTINGS,
    LARGEST_SETTINGS,
    ONE_PLACE,
    PARTNERS,
    SAMPLED_PAIRS,
    PartnerIndices,
    largest_features,
    local_features,
    most_alike,
    overlapping,
    shortlist,
)
from mkpc_kaggle.setup.assembly import Assembly

IMAGES_AT_A_TIME = 100  # whose features are in memory
# With more images, only pairs that may overlap are matched, unless most do; with fewer, all pairs
# take less time than a mistake costs.
MIN_FILTERED = 40
MAX_IMAGES = 200  # with more, each image has a shortlist instead of all pairs
# Of the time left, for trials of unturned images, and then for trials of turned images
TRIAL_SHARE = 0.25
TURN_PARTNERS = 4  # similar images per image, to find its orientation
MANY_INLIERS = 100  # with one partner; an image with this number counts as upright
MIN_INLIERS = 30  # of a turned image
MIN_GAIN = 2.0  # inliers of a turned image relative to the unturned image

# An image, its quarter turns, and an unturned image with a greater name
Key = tuple[Path, int, Path]
Near = Mapping[Path, Sequence[Path]]  # the most similar images of each image


class Named(NamedTuple):
    """An image's batch, and its name there, without suffix."""

    batch: str
    name: str


Names = Mapping[Path, Named]


def choose_pairs(
    engine: Engine,
    root: Path,
    datasets: Datasets,
    assembly: Assembly,
    session: Session,
    *,
    listed: Sequence[Ends] | None,
    rotations: bool,
) -> list[Pair]:
    """Return the pairs of all datasets: as ``listed``, or a choice that depends on the number of
    images.

    Up to ``MIN_FILTERED`` images, these are all pairs; up to ``MAX_IMAGES``, the pairs that may
    overlap; with more, a shortlist.

    With ``rotations``, images are turned by :func:`find_turns`.
    """
    ends: dict[str, Sequence[Ends]] = {}
    near: dict[Path, list[Path]] = {}
    for name, files in datasets.items():
        inside = set(files)
        ends[name] = [two for two in listed or () if two[0] in inside]
        is_large = listed is None and len(files) > MAX_IMAGES
        # Only images with partners can be compared in several orientations.
        may_lie = rotations and (bool(ends[name]) if listed else len(files) > 1)
        count = PARTNERS if is_large else TURN_PARTNERS
        partners = find_partners(engine, root, files, count) if is_large or may_lie else []
        if may_lie:
            near |= {
                a: [files[j] for j in partners[i][:TURN_PARTNERS]] for i, a in enumerate(files)
            }
        if listed is None:
            if is_large:
                indices = shortlist(partners)
            elif len(files) > MIN_FILTERED:
                indices = find_overlaps(engine, root, files)
            else:
                indices = list(combinations(range(len(files)), 2))
            ends[name] = [(files[i], files[j]) for i, j in indices]
    batches = batch_names(root, datasets)
    names = {}
    for name, files in datasets.items():
        for file in files:
            below = file.relative_to(root / name).with_suffix("").as_posix()
            names[file] = Named(batches[name], below)
    turns = find_turns(engine, near, names, root, assembly, session)
    return [
        pair_of(names, a, b, turns.get(a, 0), turns.get(b, 0))
        for pairs_of_dataset in ends.values()
        for a, b in pairs_of_dataset
    ]


def pair_of(names: Names, a: Path, b: Path, *turns: int) -> Pair:
    """Return the pair of two images of a batch, matched with these counter-clockwise quarter turns."""
    batch, name0 = names[a]
    _, name1 = names[b]
    suffix = f" turned {turns[0]} {turns[1]}" if any(turns) else ""
    return Pair(
        f"{batch}/{name0}/{name1}{suffix}", batch, str(a), str(b), turns=(turns[0], turns[1])
    )


def find_partners(engine: Engine, root: Path, files: Sequence[Path], count: int) -> PartnerIndices:
    """Return the indices of the ``count`` images most similar to each image; empty if the
    comparison failed.
    """
    compared = partial(most_alike_stored, count=count)
    known = compare_images(
        engine, root, files, FEATURE_SETTINGS, local_features, compared, [FEATURE_SETTINGS, count]
    )
    # The time is over, or the comparison failed twice. Then no image has partners.
    if known is None:
        logger.warning(f"the images of {files[0].parent} were not compared")
    partners: PartnerIndices = [[] for _ in files] if known is None else known
    return partners


def find_overlaps(engine: Engine, root: Path, files: Sequence[Path]) -> list[tuple[int, int]]:
    """Return the indices of pairs that may overlap, all pairs if the comparison failed."""
    settings = [LARGEST_SETTINGS, ONE_PLACE, SAMPLED_PAIRS]
    known = compare_images(
        engine, root, files, LARGEST_SETTINGS, largest_features, overlaps, settings
    )
    every = len(files) * (len(files) - 1) // 2
    if known is None:
        logger.warning(f"the images of {files[0].parent} were not compared; all pairs are matched")
        return list(combinations(range(len(files)), 2))
    if len(known) < every:
        logger.info(f"{files[0].parent}: {len(known)} of {plural(every, 'pair')} may overlap")
    return [(first, second) for first, second in known]


def compare_images(
    engine: Engine,
    root: Path,
    files: Sequence[Path],
    settings: str,
    features_of: Callable[[Path], bytes],
    compare_features: Callable[[Source, Sequence[str]], Any],
    result_settings: Sequence[Any],
) -> Any:
    """Return what ``compare_features`` computes from the features of all images; ``None`` if that
    failed.

    ``settings`` belong to one image's features, ``result_settings`` to the result. Both are in the
    keys of the stored results.
    """
    # By contents, so that a folder that moved is not compared again
    names = [name_below(str(root), str(file)) for file in files]
    digests_by_name = engine.digest_files(dict(zip(names, files, strict=True)))
    digests = [digests_by_name.get(name, "") for name in names]
    keys = [features_key(content, settings) for content in digests]
    key = digest([digests, *result_settings])
    partners = engine.known(key)
    if partners is None:
        # Features first: they stay if the comparison is interrupted.
        missing = {}
        for name, file in zip(names, files, strict=True):
            if name in digests_by_name:
                missing[features_key(digests_by_name[name], settings)] = partial(features_of, file)
        engine.look(missing)
        source = engine.store.source(Feature, keys)
        partners = engine.look({key: partial(compare_features, source, keys)}).get(key)
    return partners


def features_key(content: str, settings: str = FEATURE_SETTINGS) -> str:
    """Return the key of an image's features."""
    return digest([settings, content])


def overlaps(source: Source, keys: Sequence[str]) -> list[tuple[int, int]]:
    """Return :func:`overlapping` for the images with these features in a store."""
    # Up to ``MAX_IMAGES`` times 128 kB.
    found = source.data(keys)
    return overlapping([found.get(key, b"") for key in keys])


def most_alike_stored(source: Source, keys: Sequence[str], count: int) -> PartnerIndices:
    """Return :func:`most_alike` for the images with these features in a store."""

    def features() -> Iterable[bytes]:
        # In parts: the features of all images of a large folder would fill the memory.
        for start in range(0, len(keys), IMAGES_AT_A_TIME):
            part = keys[start : start + IMAGES_AT_A_TIME]
            found = source.data(part)
            yield from (found.get(key, b"") for key in part)

    return most_alike(features, count)


def find_turns(
    engine: Engine,
    near: Near,
    names: Names,
    root: Path,
    assembly: Assembly,
    session: Session,
) -> dict[Path, int]:
    """Return the counter-clockwise quarter turns that set images upright; upright images are left
    out.

    First all images are matched unturned, then images with few inliers in
    the other three orientations. An image gets its best orientation if that gains enough inliers with similar
    images, as turned so far.
    """
    recipe = assembly.recipe
    # One unit is enough to see whether an image matches at all.
    trial = replace(assembly, recipe=replace(recipe, units=recipe.units[:1], scene=None))
    found: dict[Key, int] = {}
    for tried in ((0,), (1, 2, 3)):
        # Most images are upright, and these need no other orientation.
        few = [a for a in near if most_inliers(found, near[a], a, 0) < MANY_INLIERS]
        keys = sorted({relative(a, times, b) for a in few for times in tried for b in near[a]})
        if keys:
            pairs = [pair_of(names, a, b, times, 0) for a, times, b in keys]
            engine.ask(request_of(pairs, trial, session, str(root), is_trial=True), TRIAL_SHARE)
            assert engine.state is not None
            found |= zip(keys, engine.state.inliers.tolist(), strict=True)
    turns: dict[Path, int] = {}
    for a in near:
        counts = [most_inliers(found, near[a], a, times, turns) for times in range(4)]
        best = max(range(4), key=counts.__getitem__)
        # A matcher that tolerates rotations finds some inliers in all orientations.
        if counts[0] < MANY_INLIERS and counts[best] >= max(MIN_INLIERS, MIN_GAIN * counts[0]):
            turns[a] = best
    return turns


def most_inliers(
    found: Mapping[Key, int],
    others: Iterable[Path],
    a: Path,
    times: int,
    turns: Mapping[Path, int] = MappingProxyType({}),
) -> int:
    """Return the most inliers of ``a``, turned by ``times`` quarters, with one of the others.

    ``turns`` are the orientations of the others that are known so far.
    """
    counts = (found.get(relative(a, times - turns.get(b, 0), b), 0) for b in others)
    return max(counts, default=0)


def relative(a: Path, times: int, b: Path) -> Key:
    """Return the key of image ``a``, turned by ``times`` quarters, and the unturned image ``b``."""
    # Both images turned alike match as both unturned, so only the difference counts.
    return (a, times % 4, b) if a < b else (b, -times % 4, a)
