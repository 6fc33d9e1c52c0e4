"""The figures of scores, gains and errors show the numbers that they are given."""

from math import inf

import numpy as np
import pytest
import score_figures as figures

from mkpc_kaggle.evaluation.compare import Comparison
from mkpc_kaggle.evaluation.validate import PairScore, SceneScore, Validation
from mkpc_kaggle.geometry.metrics import PoseError


def scene(name: str, *rotations: float) -> SceneScore:
    """Pairs with these rotation errors, a tenth as many metres off; infinite: failed."""
    scores = [PairScore(f"{name} {i}", ("a", "b"), 0.5, PoseError(r, r, r / 10)) for i, r in enumerate(rotations)]
    return SceneScore(name, tuple(scores))


FIRST = Validation("first", (scene("a", 0.5, 0.5, 20.0, inf), scene("b", 2.5, 2.5)))
SECOND = Validation("second", (scene("a", 0.5, 0.5, 0.5, 0.5), scene("b", 2.5, 2.5)))


def test_scores_stand_at_their_mean_average_accuracy():
    axes = figures.draw_scores([FIRST, SECOND]).axes[0]
    shown = {line.get_label(): list(line.get_xdata()) for line in axes.lines}
    assert shown["first"] == pytest.approx([0.5, 0.8, 0.65])
    assert shown["second"] == pytest.approx([1.0, 0.8, 0.9])
    assert [label.get_text() for label in axes.get_yticklabels()] == ["a", "b", "mean over scenes"]


def test_gains_stand_at_their_differences_with_intervals_around_them():
    comparison = Comparison((FIRST, SECOND))
    axes = figures.draw_gains(comparison).axes[0]
    (bar,) = axes.containers
    points, _, (spans,) = bar.lines
    assert points.get_xdata() == pytest.approx([0.5, 0, 0.25])
    shown = [(segment[0][0], segment[1][0]) for segment in spans.get_segments()]
    found = [comparison.difference(1, "a"), comparison.difference(1, "b"), comparison.difference(1)]
    assert np.array(shown) == pytest.approx(np.array([(gain.low, gain.high) for gain in found]))


def share_below(line, x: float) -> float:
    """What a rising curve says at x."""
    xs, ys = line.get_data()
    return max((y for at, y in zip(xs, ys, strict=True) if at <= x), default=0)


def test_an_error_curve_has_the_share_of_pairs_below_and_leaves_failures_out():
    rotation, translation = figures.draw_errors([FIRST, SECOND]).axes
    curve = next(line for line in rotation.lines if line.get_label() == "first")
    shares = [share_below(curve, x) for x in (0.4, 0.5, 2.5, 20, 180)]
    assert shares == pytest.approx([0, 2 / 6, 4 / 6, 5 / 6, 5 / 6])
    assert translation.get_xlabel() == "translation error in metres"
