"""Reading the store, once: a new state gets the results of today, and former results that stand in
for missing ones.
"""

from collections.abc import Callable, Mapping
from itertools import chain

import numpy as np

from mkpc_kaggle.engine.plan.schedule import sweeping_unit
from mkpc_kaggle.engine.plan.state import SCENE, State
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.image_files import known_images
from mkpc_kaggle.engine.store.keys import of_candidate
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.engine.store.scene_record import SceneRecord
from mkpc_kaggle.engine.store.tables import Export, PairEstimate, PublishedPair, UnitPoints
from mkpc_kaggle.geometry.crop_need import pays
from mkpc_kaggle.scene.export import has_files


def restore(state: State, store: Store, digests: Mapping[str, str]) -> None:
    """Find today's results, and for missing ones the results of the former table of pairs.

    ``digests`` are the known digests of the images' contents, by name.
    """
    state.use_images(known_images(store, digests))
    former = Published.of(store)
    # By contents and not by id: another test set may name the same two images.
    rows = {row.contents: row for row in former.pairs if row.contents}
    known = [index for index in range(len(state.pairs)) if state.images_of(index)]
    contents = {index: state.contents(index) for index in known}
    old = {index: rows[text] for index, text in contents.items() if text in rows}
    former_number = {name: number for number, (name, _) in enumerate(former.run.units)}

    def former_key(index: int, number: int) -> str:
        """Return the key of a unit's former points on a pair, if there are any."""
        unit = former_number.get(state.units[number].name)
        return old[index].points[unit] if unit is not None and index in old else ""

    # An extra pair has points of the sweeping unit, and no estimate. The store may have more, of another
    # recipe, or of a run in which it was a row, and a scene must not depend on that.
    sweep = sweeping_unit(state)
    own_rows = [index for index in known if index < state.rows]
    # Stage 1 first, because the keys of stage 2 depend on it. Then estimates, then scenes, for the
    # same reason.
    for stage in (False, True):
        numbers = np.flatnonzero(state.is_crop == stage).tolist()
        wanted = [
            (index, number)
            for index in known
            for number in numbers
            if index < state.rows or number == sweep
        ]
        _restore_points(state, store, wanted, former_key)
    _restore_estimates(state, store, own_rows, old)
    _restore_scenes(state, store, former, digests)


def _restore_points(
    state: State,
    store: Store,
    wanted: list[tuple[int, int]],
    former_key: Callable[[int, int], str],
) -> None:
    mkpc = state.request.recipe.mkpc
    # All keys first, because one query for thousands of keys is much faster than one for each.
    today: dict[tuple[int, int], list[str]] = {}
    for index, number in wanted:
        images = state.images_of(index)
        assert images
        today[index, number] = state.keys_of(index, number, images, state.first_stage(index))
    points = store.get(UnitPoints, chain.from_iterable(today.values()))
    former: dict[tuple[int, int], str] = {}
    for (index, number), keys in today.items():
        # Points that were found under another rule count if today's rule asks for them, too.
        stored = [
            key
            for key in keys
            if key in points
            and (not points[key].is_needed or pays(points[key].scale, points[key].detail, mkpc))
        ]
        if stored:
            state.use_points(index, number, points[stored[0]])
        elif key := former_key(index, number):
            former[index, number] = key
    # Points of former settings are better than none.
    points = store.get(UnitPoints, former.values())
    for (index, number), key in former.items():
        if key in points:
            state.use_points(index, number, points[key], is_current=False)


def _restore_estimates(
    state: State,
    store: Store,
    known: list[int],
    old: Mapping[int, PublishedPair],
) -> None:
    # From the points in use: an estimate from former points is up to date until others replace them.
    today = {index: state.estimate_key(index) for index in known if state.has[index].any()}
    former = {index: row.estimate for index, row in old.items() if row.estimate}
    by_cameras = _camera_estimate_keys(state, list(today))
    keys = [*today.values(), *former.values(), *by_cameras.values()]
    estimates = store.get(PairEstimate, keys)
    for index, key in today.items():
        if by_cameras.get(index) in estimates:
            state.use_camera_estimate(index, estimates[by_cameras[index]])
            continue
        # As long as the images are the same, the former F is better than the fallback.
        used = key if key in estimates else former.get(index, "")
        if used in estimates:
            state.use_estimate(index, estimates[used])


def _camera_estimate_keys(state: State, known: list[int]) -> dict[int, str]:
    """Return the keys of estimates from the cameras of today's scenes."""
    if not state.uses_cameras:
        return {}
    scenes = {batch: state.scene_inputs(batch)[1] for batch in state.batches}
    return {
        index: state.camera_estimate_key(index, scenes[state.pairs[index].group])
        for index in known
        if state.batch_of[index] >= 0
    }


def _restore_scenes(
    state: State, store: Store, former: Published, digests: Mapping[str, str]
) -> None:
    today = {batch: state.scene_inputs(batch)[1] for batch in state.batches}
    # The first candidate has the key of the scene's inputs.
    others = {
        batch: {name: of_candidate(key, name) for name in state.candidates[1:]}
        for batch, key in today.items()
    }
    keys = [key for named in others.values() for key in named.values()]
    scenes = store.get(SceneRecord, [*today.values(), *former.run.scenes.values(), *keys])
    marks = store.get(Export, state.request.exports)
    for batch, key in today.items():
        used = key if key in scenes else former.run.scenes.get(batch, "")
        if used not in scenes:
            continue  # the batch stays stale
        scene = scenes[used]
        if not _has_images(scene, digests):
            continue
        if used != key:
            state.use_scene(batch, scene)
            continue
        # Before the candidates: the scene whose COLMAP files exist is used.
        if batch in state.request.exports:
            state.note_files(batch, marks[batch].scene if batch in marks else "")
        state.use_candidate(batch, scene)
        for other in others[batch].values():
            if other in scenes:
                state.use_candidate(batch, scenes[other])
        if directory := state.request.exports.get(batch):
            # A scene without its COLMAP files is made again. Until then its cameras are used.
            used_scene = state.scenes[batch]
            has_mark = state.filed[batch] == used_scene.key
            if not (has_mark and has_files(directory.path, len(used_scene.models))):
                continue
        if state.uses_cameras and _lacks_estimates(state, batch):
            continue
        state.settle(batch)


def _lacks_estimates(state: State, batch: str) -> bool:
    """Return whether an estimate that came with a batch's scene is missing: a damaged row."""
    rows = state.rows_of(batch)
    is_of_scene = state.scene_source[rows] == SCENE
    return bool((is_of_scene & ~state.by_cameras[rows]).any())


def _has_images(scene: SceneRecord, digests: Mapping[str, str]) -> bool:
    """Return whether no known image of a scene has changed since; else it must not stand in."""
    return all(digests.get(name, content) == content for name, content in scene.contents.items())
