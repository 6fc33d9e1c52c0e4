"""A place: when it is given up, on workers that answer as they are told."""

from types import SimpleNamespace

import pytest

from mkpc_kaggle.engine.jobs import Cause, Failure, Loaded
from mkpc_kaggle.engine.places import Place

LOST, DONE = Failure(Cause.DIED), "an answer"


@pytest.mark.parametrize(
    ("answers", "is_closed"),
    [
        ([LOST] * 2, False),
        ([LOST] * 3, True),
        ([LOST, LOST, DONE, LOST, LOST], False),
        ([DONE] + [LOST] * 3, True),
    ],
)
def test_three_workers_lost_in_a_row_with_no_answer_between_close_a_place(answers, is_closed):
    waiting = []
    worker = SimpleNamespace(start=lambda: None, kill=lambda: None, answer=lambda: waiting.pop(0))
    place = Place("cpu", lambda: worker)
    for answer in answers:
        if place.worker is None:
            place.start(0.0)
            waiting.append(Loaded())
            place.poll(0.0)
        waiting.append(answer)
        place.poll(0.0)
    assert bool(place.closed) == is_closed
