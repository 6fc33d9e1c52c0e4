"""The table of features: looks at single images, or at the images of a dataset."""

from collections.abc import Callable, Mapping

from mkpc_kaggle.engine.jobs import Failure, LookJob
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.losses import Losses

Key = tuple[str, str]  # digest of the contents, digest of the settings


class Features:
    """The looks that are wanted: ``found`` are their features so far, by key."""

    def __init__(self, journal: Journal) -> None:
        self.found: dict[Key, bytes] = {}
        self._journal = journal
        self._pending: dict[Key, LookJob] = {}
        self._losses: Losses[Key] = Losses()

    def want(self, looks: Mapping[Key, Callable[[], bytes]]) -> None:
        """Replace the looks. Features that the journal has are found."""
        known = {key: self._journal.feature(*key) for key in looks}
        self.found = {key: value for key, value in known.items() if value is not None}
        self._pending = {key: LookJob(key, do) for key, do in looks.items() if key not in self.found}

    def has_work(self, _: float) -> bool:
        return bool(self._pending)

    def next(self, _: float) -> LookJob | None:
        return self._pending.pop(next(iter(self._pending))) if self._pending else None

    def patience(self, _: LookJob, unknown: float) -> float:
        return unknown

    def save(self, job: LookJob, answer: bytes, _: float) -> None:
        self.found[job.key] = answer
        self._journal.save_feature(*job.key, answer)

    def lose(self, job: LookJob, failure: Failure) -> None:
        if not self._losses.add([job.key], failure):
            self._pending[job.key] = job
