"""Which pairs more work may help, and whether it does."""

from collections.abc import Iterable, Sequence

from mkpc_kaggle.engine.jobs import Phase, Record, Stretch, chunks
from mkpc_kaggle.recipe import Unit, UpgradeConfig

ROUND = 4
"""Jobs of an upgrade whose gain is looked at together."""


def is_weak(record: Record, config: UpgradeConfig) -> bool:
    """Whether more work may help: few inliers, a low share of them, or an uncertain critical region."""
    unsure = record.regions is not None and not all(region.cropped for region in record.regions)
    return (
        record.inliers < config.below_inliers
        or record.inliers < config.below_share * record.matches
        or (config.uncertain and unsure)
    )


def inliers_before(record: Record) -> int:
    """The inliers of a pair before it was upgraded."""
    return record.inliers if record.before is None else record.before


class Rounds:
    """Weak pairs get the extra units in rounds of jobs, until a round gains nothing; then ``over``."""

    def __init__(self, config: UpgradeConfig) -> None:
        self.over = False
        self._least_gain = config.least_gain
        self._pairs: dict[int, list[int]] = {}

    def cut(self, weak: Iterable[int], units: tuple[Unit, ...]) -> list[Stretch]:
        """Stretches of the pairs ``weak``, each in its round; in none if no unit is an extra one."""
        extras = any(unit.extra for unit in units)
        stretches = [
            Stretch(Phase.UPGRADE, indices, units, round=1 + number // ROUND if extras else 0)
            for number, indices in enumerate(chunks(weak))
        ]
        for stretch in stretches:
            self._pairs.setdefault(stretch.round, []).extend(stretch.indices)
        return stretches

    def judged_before(self, stretch: Stretch) -> list[int]:
        """The pairs whose gain decides whether a stretch's round begins: those of the round before the last.

        Not the last round, for which workers would have to wait, and not what happens to be back: the same run
        has to end with the same bytes.
        """
        return self._pairs.get(stretch.round - 2, []) if stretch.round > 0 and not self.over else []

    def judge(self, records: Sequence[Record]) -> str:
        """Look at a round's gain; why the extra units are over now, or nothing."""
        before = sum(inliers_before(record) for record in records)
        after = sum(record.inliers for record in records)
        if after - before > self._least_gain * before:
            return ""
        self.over = True
        return f"extra units end: the last {len(records)} pairs went from {before} to {after} inliers"
