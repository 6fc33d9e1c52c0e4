"""The version of the results that was published last: the run, its pairs, and the results they name.

Nothing else decides which results reports show. If the files of that version could not be written,
an event states why.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.image_files import known_images, stored_digests
from mkpc_kaggle.engine.store.rows import from_bytes
from mkpc_kaggle.engine.store.tables import PublishedPair, PublishedRun, SceneRecord, UnitPoints
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.scene.view_graph import BatchImage


@dataclass(frozen=True, eq=False)
class Published:
    """A version of a run's results. ``pairs`` are all pairs in order, those for scenes alone at the
    end.
    """

    run: PublishedRun = field(default_factory=PublishedRun)
    pairs: Sequence[PublishedPair] = ()

    @classmethod
    def of(cls, store: Store) -> Self:
        """Return the version in a store, which is empty if the run has not published yet."""
        for run in store.all(PublishedRun):
            numbers = range(run.pairs)
            pairs = store.get(PublishedPair, numbers)
            # Damaged rows are missing, and a reader has the others.
            return cls(run, [pairs[number] for number in numbers if number in pairs])
        return cls()

    @property
    def rows(self) -> list[PublishedPair]:
        """The pairs of the test set, without the pairs for scenes alone."""
        return [pair for pair in self.pairs if pair.number < self.run.rows]

    @property
    def image_names(self) -> list[str]:
        """The distinct names of all images, in order."""
        return list(dict.fromkeys(name for row in self.pairs for name in (row.image0, row.image1)))

    @property
    def scene_keys(self) -> list[str]:
        """The keys of the scenes in use, and of their other candidates."""
        rivals = [key for keys in self.run.rivals.values() for key in keys]
        return [*self.run.scenes.values(), *rivals]

    @property
    def keys(self) -> list[str]:
        """The keys of all results that this version names."""
        points = [key for row in self.pairs for key in row.points]
        estimates = [row.estimate for row in self.pairs]
        return [key for key in [*points, *estimates, *self.scene_keys, *self.run.trials] if key]

    def points_of(self, store: Store, row: PublishedPair) -> dict[str, Matches]:
        """Return a pair's matches by unit, in the recipe's order."""
        data = store.data(UnitPoints, list(filter(None, row.points)))
        named = zip(self.run.units, row.points, strict=True)
        return {name: from_bytes(data[key]) for (name, _), key in named if key in data}

    def scenes_of(self, store: Store) -> dict[str, SceneRecord]:
        """Return the present reconstruction of each batch that has one."""
        stored = store.get(SceneRecord, self.scene_keys)
        scenes = {}
        for batch, key in self.run.scenes.items():
            if key not in stored:
                continue
            rivals = self.run.rivals.get(batch, ())
            others = [stored[rival] for rival in rivals if rival in stored]
            # A batch may have another name than when its scene was stored: the key has only its
            # contents.
            scenes[batch] = replace(stored[key].against(others), batch=batch)
        return scenes


def read_images(store: Store, row: PublishedPair) -> tuple[BatchImage, ...]:
    """Return both images of a pair as last read, or an empty tuple if one is unknown."""
    names = [row.image0, row.image1]
    images = known_images(store, stored_digests(store, names))
    return tuple(images[name] for name in names) if images.keys() >= set(names) else ()
