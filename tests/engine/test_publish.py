"""The last gate before the submission: a matrix that is no F costs its own row."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from rectified import THREE_UNITS, RectifiedMatcher, run, sources, write_pairs

from mkpc_kaggle.data.competition import submission_problem
from mkpc_kaggle.engine import places
from mkpc_kaggle.engine.request import Estimated, EstimateJob
from mkpc_kaggle.engine.worker import do_estimates_job


def estimate_wrongly(F: np.ndarray, job: EstimateJob) -> tuple[Estimated, ...]:
    first, *others = do_estimates_job(job)
    facts = {**first.facts, "F": F.ravel().tolist()}
    return replace(first, facts=facts), *others


@pytest.mark.parametrize(
    "F", [np.zeros((3, 3)), np.full((3, 3), np.nan), np.full((3, 3), np.inf), np.eye(3)]
)
def test_a_matrix_that_is_no_f_becomes_the_fallback_and_the_file_is_valid(
    tmp_path, monkeypatch, F
):
    pairs = write_pairs(tmp_path / "images", 1)
    monkeypatch.setattr(places, "estimates_runner", lambda **_: partial(estimate_wrongly, F))
    output = tmp_path / "submission.csv"
    report = run(pairs, THREE_UNITS, RectifiedMatcher(), tmp_path / "work", output=output)
    assert sources(report) == ["fallback"]
    assert submission_problem(output, [pair.id for pair in pairs]) == ""
