"""What happened in a session: in the journal as events, and as values for the report."""

from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.console import Progress
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.journal_reader import Event, EventKind


class Chronicle:
    """Faults and decisions of a session, each noted once, and the numbers of its results."""

    def __init__(self, journal: Journal, budget: Budget, progress: Progress) -> None:
        self.progress = progress
        self.faults: list[str] = []
        self.explanations: list[Event] = []
        self.units_run = self.estimated = 0
        self._journal, self._budget = journal, budget

    def note(self, kind: EventKind, text: str) -> Event:
        event = Event(kind, self._budget.spent(), text)
        self._journal.note(event)
        return event

    def explain(self, text: str) -> None:
        self.explanations.append(self.note(EventKind.PLAN, text))

    def fault(self, text: str) -> None:
        if text not in self.faults:
            self.faults.append(text)
            self.note(EventKind.FAULT, text)
