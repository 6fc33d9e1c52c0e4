"""A worker of matching, without an engine: which units of a job it begins."""

from dataclasses import replace

import pytest
from faulty import NarrowMatcher
from rectified import THREE_UNITS

from mkpc_kaggle.data.images import content_digest
from mkpc_kaggle.engine.request import MatchJob, MatchPlan, PairInputs
from mkpc_kaggle.engine.store import Source
from mkpc_kaggle.engine.worker import MatchRunner
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.scene.view_graph import BatchImage


def job_of(pairs, plan):
    """A job of a plan on pairs whose images are as they are stored."""
    inputs = []
    for index, pair in enumerate(pairs):
        images = [
            BatchImage(path.name, content_digest(path), Size(1, 1)) for path in pair.images
        ]
        inputs.append(PairInputs(index, pair, tuple(images), {}))
    return MatchJob(tuple(inputs), THREE_UNITS, Source(), plan)


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
        limit=None,
    )
    answer = runner(job_of(pairs[:8], MatchPlan(0, [*range(8)], [0], [1e5], seconds, [])))
    assert matcher.sizes == sizes
    assert sum(bool(outcome.results) for outcome in answer) == sum(sizes)


def test_an_image_that_changed_since_the_run_read_it_fails_its_pair_alone(pairs):
    matcher = NarrowMatcher(most=8)
    runner = MatchRunner(
        lambda: Pipeline(THREE_UNITS, {matcher.name: matcher}.__getitem__), limit=None
    )
    job = job_of(pairs[:2], MatchPlan(0, [0, 1], [0], [0.0], 1e6, []))
    first, second = job.pairs
    known = (first.images[0], replace(first.images[1], digest="other"))
    changed, good = runner(replace(job, pairs=(replace(first, images=known), second)))
    assert changed.failure.endswith(": changed during the run")
    assert (changed.results, len(good.results)) == ((), 1)
