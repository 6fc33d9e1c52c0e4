"""A worker of matching, without an engine: which units of a job it begins."""

import pytest
from faulty import NarrowMatcher
from rectified import SWEEP, THREE_UNITS

from mkpc_kaggle.engine.jobs import MatchJob, Phase
from mkpc_kaggle.engine.workers.worker import MatchRunner
from mkpc_kaggle.pipeline.stages import Pipeline


@pytest.mark.parametrize(
    ("seconds", "sizes"),
    [
        (1e6, [8]),
        # Each minibatch counts with all its pairs, from the present time on.
        (5e5, [4, 4]),
        (1.5e5, [1] * 8),
        (0.5e5, []),
    ],
)
def test_a_minibatch_that_would_not_end_in_time_gets_smaller_or_does_not_begin(
    pairs, seconds, sizes
):
    matcher = NarrowMatcher(most=8)
    runner = MatchRunner(
        lambda: Pipeline(THREE_UNITS, {matcher.name: matcher}.__getitem__, minibatch=8),
        is_limited=False,
    )
    job = MatchJob(
        Phase.SWEEP,
        tuple(range(8)),
        (SWEEP,),
        expected=(1e5,),
        seconds=seconds,
        pairs=tuple(pairs[:8]),
        names=tuple((pair.file0, pair.file1) for pair in pairs[:8]),
        stage_1=((),) * 8,
        crops=((),) * 8,
    )
    answer = runner(job)
    assert matcher.sizes == sizes
    assert sum(bool(outcome.results) for outcome in answer) == sum(sizes)
