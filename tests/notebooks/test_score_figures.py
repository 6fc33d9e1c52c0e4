"""The figures of scores, gains and errors show the numbers that they are given."""

from math import inf

import pytest
import score_figures as figures

from mkpc_kaggle.evaluation.compare import Comparison
from mkpc_kaggle.evaluation.validate import PairScore, SceneScore, Validation
from mkpc_kaggle.geometry.metrics import PoseError


def scene(name: str, *rotations: float) -> SceneScore:
    """Pairs with these rotation errors, a tenth as many metres off; infinite: failed."""
    scores = [PairScore(f"{name} {i}", 0.5, PoseError(r, r, r / 10)) for i, r in enumerate(rotations)]
    return SceneScore(name, tuple(scores))


FIRST = Validation("first", (scene("a", 0.5, 0.5, 20.0, inf), scene("b", 2.5, 2.5)))
SECOND = Validation("second", (scene("a", 0.5, 0.5, 0.5, 0.5), scene("b", 2.5, 2.5)))


def test_scores_stand_at_their_mean_average_accuracy():
    axes = figures.draw_scores([FIRST, SECOND]).axes[0]
    shown = {line.get_label(): list(line.get_xdata()) for line in axes.lines}
    assert shown["first"] == pytest.approx([0.5, 0.8, 0.65])
    assert shown["second"] == pytest.approx([1.0, 0.8, 0.9])
    (bar,) = figures.draw_gains(Comparison((FIRST, SECOND))).axes[0].containers
    assert bar.lines[0].get_xdata() == pytest.approx([0.5, 0, 0.25])


def test_an_error_curve_has_the_share_of_pairs_below_and_leaves_failures_out():
    curve = figures.draw_errors([FIRST]).axes[0].lines[0]
    errors, shares = curve.get_data()
    assert [shares[errors <= x].max() for x in (0.5, 2.5, 20, 180)] == pytest.approx([2 / 6, 4 / 6, 5 / 6, 5 / 6])
