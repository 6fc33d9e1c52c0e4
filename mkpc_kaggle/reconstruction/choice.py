"""Which images of a folder are matched with each other, and which of them are turned for it."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.console import warn
from mkpc_kaggle.engine.engine import Engine
from mkpc_kaggle.engine.session import Session, request_of
from mkpc_kaggle.engine.settings import digest
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.reconstruction import orientation
from mkpc_kaggle.reconstruction.folder import Datasets, Ends, root_of
from mkpc_kaggle.reconstruction.likeness import (
    FEATURE_SETTINGS,
    PARTNERS,
    Partners,
    compare,
    local_features,
    shortlist,
)

MAX_IMAGES = 100  # with more, each image has a shortlist instead of all pairs
TRIAL_SHARE = 0.25  # of the time left, for trials of each kind of orientation


def choose_pairs(
    engine: Engine,
    datasets: Datasets,
    assembly: Assembly,
    session: Session,
    *,
    listed: Sequence[Ends] | None,
    rotations: bool,
) -> list[Pair]:
    """Return the pairs of all datasets: those ``listed``, all of up to ``MAX_IMAGES`` images, or a shortlist.

    With ``rotations``, images are turned as the recipe's first unit matches them best.
    """
    ends = {
        name: [two for two in listed or () if two[0].parent == files[0].parent] for name, files in datasets.items()
    }
    large = {name for name, files in datasets.items() if listed is None and len(files) > MAX_IMAGES}
    lying = {name for name, files in datasets.items() if rotations and (ends[name] if listed else len(files) > 1)}
    counts = {name: PARTNERS if name in large else orientation.TURN_PARTNERS for name in sorted(large | lying)}
    partners = find_partners(engine, datasets, counts)
    near = {name: [others[: orientation.TURN_PARTNERS] for others in partners[name]] for name in sorted(lying)}
    turns = find_turns(engine, datasets, near, assembly, session)
    pairs = []
    for name, files in datasets.items():
        indices = shortlist(partners[name]) if name in large else combinations(range(len(files)), 2)
        for a, b in [(files[i], files[j]) for i, j in indices] if listed is None else ends[name]:
            turned = (turns.get(a, 0), turns.get(b, 0))
            suffix = f" turned {turned[0]} {turned[1]}" if any(turned) else ""
            pairs.append(Pair(f"{name}/{a.stem}/{b.stem}{suffix}", name, str(a), str(b), turns=turned))
    return pairs


def find_partners(engine: Engine, datasets: Datasets, counts: Mapping[str, int]) -> dict[str, Partners]:
    """Return the most similar images of each image, by dataset; none where they could not be compared."""
    digests: dict[str, list[str]] = {}
    looks, comparisons = dict[tuple[str, str], Callable[[], bytes]](), {}
    for name, count in counts.items():
        files = {str(file): file for file in datasets[name]}
        found = engine.digest_files(files)
        looks |= {(found[key], FEATURE_SETTINGS): partial(local_features, files[key]) for key in found}
        digests[name] = [found.get(key, "") for key in files]
        key = digest(digests[name]), digest([FEATURE_SETTINGS, count])
        comparisons[name] = key, partial(compare, engine.journal.path.parent, digests[name], count)
    known = engine.look(dict(comparisons.values()), compute=False)
    if any(key not in known for key, _ in comparisons.values()):
        engine.look(looks)
        known = engine.look(dict(comparisons.values()))
    partners = {}
    for name, (key, _) in comparisons.items():
        if key not in known:
            warn(f"the images of {name} were not compared")
        partners[name] = json.loads(known[key]) if key in known else [[] for _ in datasets[name]]
    return partners


def find_turns(
    engine: Engine, datasets: Datasets, partners: Mapping[str, Partners], assembly: Assembly, session: Session
) -> dict[Path, int]:
    """Return by how many quarters, counter-clockwise, images are turned."""
    recipe = assembly.recipe
    trial = replace(assembly, recipe=replace(recipe, units=recipe.units[:1], scene=None))
    found: dict[str, dict[orientation.Key, int]] = {name: {} for name in partners}
    for keys_of in (orientation.upright_keys, orientation.turned_keys):
        keys = [(name, key) for name, near in partners.items() for key in keys_of(near, found[name])]
        pairs = [orientation.pair_of(key, name, datasets[name]) for name, key in keys]
        if pairs:
            engine.ask(request_of(pairs, trial, session, str(root_of(datasets))), TRIAL_SHARE)
            for (name, key), inliers in zip(keys, engine.state.inliers.tolist(), strict=True):
                found[name][key] = inliers
    return {
        datasets[name][i]: times
        for name, near in partners.items()
        for i, times in enumerate(orientation.turns_of(near, found[name]))
    }
