"""What is known of all pairs of a run, and what may still come of them: what the planner decides upon."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

from mkpc_kaggle.engine.jobs import JobFailure, Outcome, Phase
from mkpc_kaggle.engine.records import PairRecord, UnitRecord
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.scene.choose import Choice


class RunState:
    """The records of all pairs, by index; from index ``asked`` on they are of pairs that no row names.

    ``lacking`` counts the asked pairs that have an F and lack a regular unit, by its name. ``left_alone`` are
    pairs that get nothing more in this run.
    """

    def __init__(self, recipe: Recipe, records: list[PairRecord], asked: int) -> None:
        self.recipe = recipe
        self.records = records
        self.asked = asked
        self.left_alone: set[int] = set()
        self.lacking = Counter(unit for record in records for unit in self._lacks(record))

    def can_gain(self, index: int, units: Iterable[Unit]) -> bool:
        """Whether a pair may have one of the units that it has not had."""
        return index not in self.left_alone and bool(self.records[index].lacking(units))

    def lacking_units(self, indices: Iterable[int], units: Sequence[Unit]) -> list[Unit]:
        """Each of the units that some of the pairs have not had, once."""
        return list(dict.fromkeys(unit for index in indices for unit in self.records[index].lacking(units)))

    @property
    def workable(self) -> list[PairRecord]:
        """The asked pairs that have an F and may be worked on."""
        return [one for one in self.records[: self.asked] if one.units and one.index not in self.left_alone]

    def stuck(self, outcome: Outcome) -> str:
        """Leave a pair alone that nothing can come of; why it keeps the F that it has, if it has one."""
        record, former = outcome.record, self.records[outcome.record.index]
        if outcome.results or not record.failure or not record.reached:
            return ""
        self.left_alone.add(record.index)
        return f"pair {record.index} keeps the F it has: {record.failure}" if former.units else ""

    def merge(self, outcome: Outcome, phase: Phase) -> Outcome | None:
        """The outcome to keep, if the job brought anything: a unit more, or the reason why there can be none."""
        record, former = outcome.record, self.records[outcome.record.index]
        if len(record.units) <= len(former.units) and (former.reached or not record.reached):
            return None
        record = record.after(former, former.inliers_before if phase is Phase.UPGRADE else former.before)
        self._put(record)
        return Outcome(record, outcome.results)

    def leave_alone(self, index: int, failure: JobFailure) -> None:
        """The pair keeps the F that it has, and gets nothing more in this run; a later one tries again."""
        self.left_alone.add(index)
        if not self.records[index].reached:
            self._put(PairRecord.untouched(index, f"left alone: {failure}"))

    def give_up(self, index: int, units: Sequence[Unit], failure: JobFailure) -> Outcome:
        """The pair keeps the F that it has; the units are marked as had, with the reason."""
        record, reason = self.records[index], f"given up: {failure}"
        empty = tuple(UnitRecord(unit.name, unit.stage, 0, 0, 0.0, 0.0, reason) for unit in units)
        message = record.failure if record.reached else reason
        self._put(replace(record, units=record.units + empty, failure=message))
        results = tuple(UnitResult(unit, Matches.empty(), failure=reason) for unit in units)
        return Outcome(self.records[index], results)

    def set_scene(self, index: int, choice: Choice) -> None:
        """Which F a pair gets by the reconstruction of its batch."""
        self.records[index] = replace(self.records[index], scene=choice)

    def _put(self, record: PairRecord) -> None:
        had, lacks = self._lacks(self.records[record.index]), self._lacks(record)
        self.lacking.subtract(had - lacks)
        self.lacking.update(lacks - had)
        self.records[record.index] = record

    def _lacks(self, record: PairRecord) -> set[str]:
        """The regular units that a pair is to get yet, if it has an F."""
        if not record.units or record.index >= self.asked:
            return set()
        return {unit.name for unit in record.lacking(self.recipe.regular)}
