"""What is durable of a pair: its F, how it came about, and what each unit found and cost."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL, Matrix3
from mkpc_kaggle.pipeline.pair import PairMatch, Regions
from mkpc_kaggle.recipe import Unit

NOT_REACHED = "not reached in time"


@dataclass(frozen=True)
class UnitRecord:
    """What one unit found on one pair: counts of matches and of inliers among them, and seconds."""

    unit: str
    stage: int
    matches: int
    inliers: int
    encode_seconds: float
    match_seconds: float
    failure: str


@dataclass(frozen=True, eq=False)
class PairRecord:
    """What is known of one pair: its F (its E, where the pair has intrinsics) and how it came about.

    ``failure`` is empty, or says why ``F`` is the fallback. The seconds are those of all jobs on the pair.
    ``before`` is the number of inliers that it had when it was first upgraded; ``None`` if it never was.
    """

    index: int
    F: Matrix3
    failure: str
    units: tuple[UnitRecord, ...] = ()
    regions: Regions | None = None
    decode_seconds: float = 0.0
    cluster_seconds: float = 0.0
    estimate_seconds: float = 0.0
    before: int | None = None

    @classmethod
    def untouched(cls, index: int, reason: str = NOT_REACHED) -> "PairRecord":
        return cls(index, FALLBACK_FUNDAMENTAL.copy(), reason)

    @classmethod
    def of(cls, index: int, match: PairMatch) -> "PairRecord":
        """The record of an estimated pair."""
        ends = np.cumsum([len(result.matches) for result in match.results])
        inliers = np.split(match.estimate.inliers, ends[:-1])
        units = tuple(
            UnitRecord(
                result.unit.name,
                result.unit.stage,
                len(result.matches),
                int(mask.sum()),
                result.encode_seconds,
                result.match_seconds,
                result.failure,
            )
            for result, mask in zip(match.results, inliers, strict=True)
        )
        estimate, seconds = match.estimate, (match.decode_seconds, match.cluster_seconds, match.estimate_seconds)
        return cls(index, estimate.matrix, estimate.failure, units, match.regions, *seconds)

    def after(self, former: "PairRecord", before: int | None) -> "PairRecord":
        """The record of a later job on a pair: with the seconds of the ``former`` ones, and their regions."""
        return replace(
            self,
            regions=self.regions or former.regions,
            decode_seconds=former.decode_seconds + self.decode_seconds,
            cluster_seconds=former.cluster_seconds + self.cluster_seconds,
            estimate_seconds=former.estimate_seconds + self.estimate_seconds,
            before=before,
        )

    @property
    def reached(self) -> bool:
        return self.failure != NOT_REACHED

    @property
    def inliers(self) -> int:
        return sum(unit.inliers for unit in self.units)

    @property
    def inliers_before(self) -> int:
        """The inliers of a pair before it was upgraded."""
        return self.inliers if self.before is None else self.before

    @property
    def matches(self) -> int:
        return sum(unit.matches for unit in self.units)

    def has(self, unit: Unit) -> bool:
        return any(record.unit == unit.name for record in self.units)

    def lacking(self, units: Iterable[Unit]) -> list[Unit]:
        """Those of ``units`` that the pair has not had."""
        had = {record.unit for record in self.units}
        return [unit for unit in units if unit.name not in had]
