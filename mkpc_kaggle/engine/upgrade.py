"""Which pairs more work may help, and whether it does."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from mkpc_kaggle.engine.jobs import Chunk, Phase, split
from mkpc_kaggle.engine.records import PairRecord
from mkpc_kaggle.recipe import Unit


@dataclass(frozen=True)
class UpgradeConfig:
    """Which pairs are weak."""

    below_inliers: int = 100
    below_share: float = 0.0
    uncertain: bool = True
    least_gain: float = 0.01


def is_weak(record: PairRecord, config: UpgradeConfig) -> bool:
    """Whether more work may help: few inliers, a low share of them, or an uncertain critical region."""
    unsure = record.regions is not None and not all(region.cropped for region in record.regions)
    return (
        record.inliers < config.below_inliers
        or record.inliers < config.below_share * record.matches
        or (config.uncertain and unsure)
    )


class UpgradeRounds:
    """Weak pairs get the extra units in rounds of jobs, until a round gains nothing; then ``over``."""

    def __init__(self, config: UpgradeConfig) -> None:
        self.over = False
        self._least_gain = config.least_gain
        self._pairs: dict[int, list[int]] = {}

    def split(self, weak: Iterable[int], units: tuple[Unit, ...]) -> list[Chunk]:
        """Chunks of the pairs ``weak``, each in its round; in none if no unit is an extra one."""
        chunks = [Chunk(Phase.UPGRADE, indices, units) for indices in split(weak)]
        for chunk in chunks:
            self._pairs.setdefault(chunk.round, []).extend(chunk.indices)
        return chunks

    def judged_before(self, chunk: Chunk) -> list[int]:
        """The pairs whose gain decides whether a chunk's round begins: those of the round before the last.

        Not the last round, for which workers would have to wait, and not what happens to be back: the same run
        has to end with the same bytes.
        """
        return self._pairs.get(chunk.round - 2, []) if chunk.round > 0 and not self.over else []

    def judge(self, records: Sequence[PairRecord]) -> str:
        """Look at a round's gain; why the extra units are over now, or nothing."""
        before = sum(record.inliers_before for record in records)
        after = sum(record.inliers for record in records)
        if after - before > self._least_gain * before:
            return ""
        self.over = True
        return f"extra units end: the last {len(records)} pairs went from {before} to {after} inliers"
