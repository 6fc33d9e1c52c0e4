"""The scenes of a run's batches: the one in use of each, and the candidates to make."""

from collections.abc import Collection, Iterable, Sequence

from mkpc_kaggle.engine.plan.blame import Item
from mkpc_kaggle.engine.store.keys import of_candidate
from mkpc_kaggle.engine.store.tables import SceneRecord
from mkpc_kaggle.scene.candidates import ALL_UNITS, best_of


class SceneState:
    """The scenes ``in_use`` by batch; ``stale``, the batches whose scene is not today's; and
    ``reconstructing``, the batches of jobs under way.

    A scene is the best of the ``candidates``: ``made`` has those from today's results, once the
    first is made; ``untried`` are the missing ones, and ``trying`` the ones of jobs under way,
    as (batch, candidate). The batches ``with_files`` have a folder for COLMAP's files, and ``filed``
    has the key of the scene whose files it has.
    """

    def __init__(
        self, batches: Iterable[str], candidates: Sequence[str], with_files: Collection[str]
    ) -> None:
        self.candidates = candidates
        self.with_files = with_files
        self.in_use: dict[str, SceneRecord] = {}
        self.stale = set(batches)
        self.reconstructing: set[str] = set()
        self.made: dict[str, dict[str, SceneRecord]] = {}
        self.untried: dict[str, list[str]] = {}
        self.trying: set[tuple[str, str]] = set()
        self.filed: dict[str, str] = {}

    # Jobs

    def begin(self, batch: str, candidate: str) -> None:
        """Note a candidate of a job under way. The batch stays stale: the job may be lost."""
        if candidate == ALL_UNITS:
            self.reconstructing.add(batch)
        else:
            self.trying.add((batch, candidate))

    def end(self, batch: str, candidate: str) -> None:
        if candidate == ALL_UNITS:
            self.reconstructing.discard(batch)
        else:
            self.trying.discard((batch, candidate))

    # Results

    def use(self, batch: str, record: SceneRecord) -> SceneRecord:
        """Use a candidate, if it is the best one so far. Return the scene in use.

        The first candidate is always from newer results than the others, and replaces them. With
        files, the best candidate is used once its files are written.
        """
        if record.candidate == ALL_UNITS:
            self.made[batch] = {}
        made = self.made[batch]
        made[record.candidate] = record
        used = self.best_candidate(batch)
        if batch in self.with_files and made[used].key != self.filed.get(batch):
            filed = [name for name, scene in made.items() if scene.key == self.filed.get(batch)]
            used = next(iter(filed), ALL_UNITS)
        others = [other for name, other in made.items() if name != used]
        self.in_use[batch] = made[used].against(others)
        return self.in_use[batch]

    def best_candidate(self, batch: str) -> str:
        """Return the finished candidate with the smallest disagreement."""
        made = self.made[batch]
        return best_of({name: made[name].disagreement for name in self.candidates if name in made})

    def is_of_today(self, batch: str, scene: str) -> bool:
        """Return whether the first candidate is from the same results as ``scene``, and today's."""
        first = self.made.get(batch, {}).get(ALL_UNITS)
        return first is not None and first.key == scene and batch not in self.stale

    @property
    def rivals(self) -> dict[str, list[str]]:
        """The keys of the candidates that are not in use, by batch."""
        return {
            batch: [scene.key for scene in made.values() if scene.key != self.in_use[batch].key]
            for batch, made in self.made.items()
        }

    def note_files(self, batch: str, key: str) -> None:
        """Note that the batch's folder has the files of the scene with this key."""
        self.filed[batch] = key

    # Missing candidates

    def note_change(self, batch: str) -> None:
        """Note that the inputs of a batch's scene have changed."""
        self.stale.add(batch)
        # Until the first candidate is made again
        self.untried.pop(batch, None)

    def settle(self, batch: str, given_up: Collection[Item]) -> None:
        """Note that the scene of a batch is today's, and which other candidates are missing."""
        self.stale.discard(batch)
        self.try_others(batch, given_up)

    def try_others(self, batch: str, given_up: Collection[Item]) -> None:
        """Note which other candidates are missing: the first one is from today's results.

        With files, the best one is finally made again, if its files are missing.
        """

        def is_open(candidate: str) -> bool:
            return ("scene", batch, of_candidate(scene, candidate)) not in given_up

        made = self.made[batch]
        scene = made[ALL_UNITS].key
        missing = [name for name in self.candidates if name not in made and is_open(name)]
        best = self.best_candidate(batch)
        lacks_files = batch in self.with_files and made[best].key != self.filed.get(batch)
        if not missing and lacks_files and is_open(best):
            missing = [best]
        self.untried[batch] = missing

    def give_up(self, batch: str, candidate: str, scene: str, given_up: Collection[Item]) -> None:
        """Try a candidate no more until the results of its batch change."""
        if candidate == ALL_UNITS:
            # The batch becomes stale again when its inputs change.
            self.stale.discard(batch)
        elif self.is_of_today(batch, scene):
            self.try_others(batch, given_up)
