"""Work that lost workers: its items are retried singly, and an item that is lost twice alone is skipped."""

from collections import Counter
from collections.abc import Hashable, Sequence
from typing import Generic, TypeVar

from mkpc_kaggle.engine.jobs import Failure

MAX_TRIES = 2

Key = TypeVar("Key", bound=Hashable)


class Losses(Generic[Key]):
    """``alone`` are the items to try singly, ``skipped`` the failures of the items that are no longer tried."""

    def __init__(self) -> None:
        self.alone: set[Key] = set()
        self.skipped: dict[Key, Failure] = {}
        self._tries: Counter[Key] = Counter()

    def add(self, lost: Sequence[Key], failure: Failure) -> bool:
        """Record the items of a lost job. Return whether its single item is skipped from now on."""
        self.alone.update(lost)
        if len(lost) != 1:
            return False
        self._tries[lost[0]] += 1
        if self._tries[lost[0]] < MAX_TRIES:
            return False
        self.skipped[lost[0]] = failure
        return True
