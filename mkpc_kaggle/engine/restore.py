"""Reading the store, once: a new state gets the results of today. Until a pair has a new F, the one in
the last table of pairs stands in, and no other result that is not today's.
"""

from collections.abc import Mapping
from itertools import chain

import numpy as np

from mkpc_kaggle.engine.plan.schedule import sweeping_unit
from mkpc_kaggle.engine.plan.state import EARLIER, FALLBACK, SCENE, SOURCES, State
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.image_files import known_images
from mkpc_kaggle.engine.store.keys import of_candidate
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.engine.store.tables import Export, PairEstimate, SceneRecord, UnitPoints
from mkpc_kaggle.geometry.crop_need import pays
from mkpc_kaggle.geometry.robust import ModelKind
from mkpc_kaggle.scene.export import DATABASE


def restore(state: State, store: Store, digests: Mapping[str, str]) -> None:
    """Find today's results. ``digests`` are the known digests of the images' contents, by name."""
    state.use_images(known_images(store, digests))
    known = [index for index in range(len(state.pairs)) if state.images_of(index)]
    # An extra pair has points of the sweeping unit, and no estimate. The store may have more, of another
    # recipe, or of a run in which it was a row, and a scene must not depend on that.
    sweep = sweeping_unit(state)
    own_rows = [index for index in known if index < state.rows]
    _restore_earlier(state, store, own_rows)
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
        _restore_points(state, store, wanted)
    _restore_estimates(state, store, own_rows)
    _restore_scenes(state, store)


def _restore_earlier(state: State, store: Store, known: list[int]) -> None:
    """Use the F of the last table of pairs."""
    written = {}
    for row in Published.of(store).rows:
        if row.source != SOURCES[FALLBACK]:
            # By contents and not by id: another test set may name the same two images.
            written[row.contents, row.model] = row
    for index in known:
        # An E is no F: the user has given the intrinsics since, or no longer does.
        model = ModelKind.F if state.pairs[index].intrinsics is None else ModelKind.E
        former = written.get((state.contents(index), model))
        if former is None:
            continue
        # An F that stood in for the pair's estimate was a scene's.
        stood_in = former.source == SOURCES[EARLIER] and bool(former.estimate)
        is_by_scene = stood_in or former.source == SOURCES[SCENE]
        state.use_earlier(index, former.F, is_by_scene=is_by_scene)


def _restore_points(state: State, store: Store, wanted: list[tuple[int, int]]) -> None:
    mkpc = state.request.recipe.mkpc
    # All keys first, because one query for thousands of keys is much faster than one for each.
    today: dict[tuple[int, int], list[str]] = {}
    for index, number in wanted:
        images = state.images_of(index)
        assert images
        today[index, number] = state.keys_of(index, number, images, state.first_stage(index))
    points = store.get(UnitPoints, chain.from_iterable(today.values()))
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


def _restore_estimates(state: State, store: Store, known: list[int]) -> None:
    today = {index: state.estimate_key(index) for index in known if state.has[index].any()}
    estimates = store.get(PairEstimate, today.values())
    for index, key in today.items():
        if key in estimates:
            state.use_estimate(index, estimates[key])


def _restore_scenes(state: State, store: Store) -> None:
    today = {batch: state.scene_inputs(batch)[1] for batch in state.batches}
    # The first candidate has the key of the scene's inputs.
    others = {
        batch: {name: of_candidate(key, name) for name in state.scenes.candidates[1:]}
        for batch, key in today.items()
    }
    keys = [key for named in others.values() for key in named.values()]
    scenes = store.get(SceneRecord, [*today.values(), *keys])
    marks = store.get(Export, state.request.exports)
    for batch, key in today.items():
        if key not in scenes:
            continue  # the batch stays stale
        # Before the candidates: the scene whose COLMAP files exist is used.
        if batch in state.request.exports:
            state.scenes.note_files(batch, marks[batch].scene if batch in marks else "")
        state.use_candidate(batch, scenes[key])
        for other in others[batch].values():
            if other in scenes:
                state.use_candidate(batch, scenes[other])
        if directory := state.request.exports.get(batch):
            # A scene without its COLMAP files is made again. Until then its cameras are used.
            used_scene = state.scenes.in_use[batch]
            has_mark = state.scenes.filed[batch] == used_scene.key
            if not (has_mark and (directory / DATABASE).is_file()):
                continue
        state.scenes.settle(batch, state.tries.given_up)
