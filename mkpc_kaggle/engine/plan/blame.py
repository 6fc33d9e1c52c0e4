"""Blame for lost jobs: the items of a job, or its place.

One rule serves every cause: a device that fails, a worker that dies or hangs, memory that is short.

- An item that was lost twice, alone in its job, is at fault. This run skips it (:class:`Tries`).
- A place that lost three different items in a row, with no answer in between, is at fault, and is
  closed. Its losses since its last answer then say nothing about the items: they are forgiven.

The two are distinguished only if a place gets other items after a loss. Until its next answer, a
place gets no pair with a unit that was lost before, and after two losses an item that worked before
(:func:`mkpc_kaggle.engine.plan.schedule.trial_plan`). Losses that an item explains count for this
choice, too: of two places that fail, each loses the same items.
"""

from collections import Counter, deque
from collections.abc import Collection, Hashable, Iterable, Sequence

from mkpc_kaggle.engine.jobs import Failure

# Of an item alone in its job. One loss may have its cause elsewhere, such as short memory; a third
# try would rarely help and costs a worker's start.
MAX_TRIES = 2
# Losses of a place in a row, of different items, without an answer in between
MAX_LOSSES = 3
# A place that is suspected gets an item that worked before. If that is lost, too, it gets another.
PROVEN_ITEMS = MAX_LOSSES

# ("unit", pair, unit), ("matcher", unit), ("pair", pair), ("estimate", pair), ("scene", batch, key),
# ("scenes",), ("features", key) or ("estimates",). The workers of estimates give up an estimate, which
# is tried once more elsewhere: ("estimate elsewhere", pair).
Item = tuple[Hashable, ...]
OF_SCENES = ("scene", "scenes")  # kinds of items that have nothing to do with a device


class Tries:
    """The only memory of failures, for one run: nothing of it is stored, so the next run tries
    everything again.

    An item of a lost job is retried in its own job (``alone``), and given up when that job is lost
    for the second time. ``given_up`` has the reason of each item. ``proven`` are the last units of
    pairs that had an answer.
    """

    def __init__(self) -> None:
        self.alone: set[Item] = set()
        self.given_up: dict[Item, Failure] = {}
        self.proven: deque[Item] = deque(maxlen=PROVEN_ITEMS)
        self._counts: Counter[Item] = Counter()

    def lose(self, items: Sequence[Item], failure: Failure) -> bool:
        """Record the items of a lost job. Return whether it had a single item, which is now given
        up.
        """
        self.alone.update(items)
        # With several items, the cause is unknown: no try is counted.
        if len(items) != 1:
            return False
        self._counts[items[0]] += 1
        if self._counts[items[0]] < MAX_TRIES:
            return False
        self.given_up[items[0]] = failure
        return True

    def succeed(self, item: Item) -> None:
        """Record the answer to a unit of a pair: its losses had another cause."""
        self.alone.discard(item)
        del self._counts[item]  # a counter ignores a missing key
        if item not in self.proven:
            self.proven.append(item)

    def of_scenes(self) -> "Tries":
        """Return the failures of scenes alone, which no device of matching has caused."""
        kept = Tries()
        for item, failure in self.given_up.items():
            if item[0] in OF_SCENES:
                kept.given_up[item] = failure
        return kept

    def discard_proven(self, items: Collection[Item]) -> None:
        for item in items:
            if item in self.proven:
                self.proven.remove(item)

    def forgive(self, lost: Iterable[Collection[Item]]) -> list[Item]:
        """Forget the losses of a closed place. Return the items that are no longer given up."""
        taken_back = []
        for items in lost:
            for item in items:
                # Only the losses of single items were counted.
                if len(items) == 1 and self._counts[item] > 0:
                    if self._counts[item] == MAX_TRIES and item in self.given_up:
                        del self.given_up[item]
                        taken_back.append(item)
                    self._counts[item] -= 1
                if not self._counts[item]:
                    self.alone.discard(item)
        return taken_back


def different(
    lost: Iterable[frozenset[Item]], given_up: Collection[Item]
) -> tuple[frozenset[Item], ...]:
    """Return lost jobs without common items. Jobs with an item at fault are left out."""
    chosen: list[frozenset[Item]] = []
    # The smallest first: a minibatch, and a pair of it that was then lost alone, are one loss.
    for items in sorted(lost, key=len):
        is_explained = any(item in given_up for item in items)
        if not is_explained and all(items.isdisjoint(other) for other in chosen):
            chosen.append(items)
    return tuple(chosen)
