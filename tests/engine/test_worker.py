"""A worker of matching, without an engine: which units of a job it begins."""

import pytest
from faulty import NarrowMatcher
from rectified import SWEEP, THREE_UNITS

from mkpc_kaggle.data.images import content_digest
from mkpc_kaggle.engine.request import MatchJob
from mkpc_kaggle.engine.worker import MatchRunner
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
        range(8),
        [SWEEP],
        expected=[1e5],
        seconds=seconds,
        pairs=pairs[:8],
        digests=[tuple(map(content_digest, pair.images)) for pair in pairs[:8]],
    )
    answer = runner(job)
    assert matcher.sizes == sizes
    assert sum(bool(outcome.results) for outcome in answer) == sum(sizes)


def test_an_image_that_changed_since_the_run_read_it_fails_its_pair_alone(pairs):
    matcher = NarrowMatcher(most=8)
    runner = MatchRunner(
        lambda: Pipeline(THREE_UNITS, {matcher.name: matcher}.__getitem__), is_limited=False
    )
    digests = [tuple(map(content_digest, pair.images)) for pair in pairs[:2]]
    digests[0] = (digests[0][0], "other")
    job = MatchJob(range(2), [SWEEP], [0.0], 1e6, pairs[:2], digests)
    changed, good = runner(job)
    assert changed.failure.endswith(": changed during the run")
    assert (changed.results, len(good.results)) == ((), 1)
