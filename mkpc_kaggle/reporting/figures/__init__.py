"""Figures, drawn with matplotlib: everything that this package paints is painted here.

``pair`` shows one pair at a glance, ``run`` what a run did, ``scores`` how recipes do; ``canvas`` is what they
share.
"""

from mkpc_kaggle.reporting.figures.canvas import new_figure, save, to_jpeg, to_svg
from mkpc_kaggle.reporting.figures.pair import draw_pair, draw_strip
from mkpc_kaggle.reporting.figures.run import (
    draw_budget,
    draw_cameras,
    draw_crops,
    draw_groups,
    draw_parts,
    draw_upgrades,
)
from mkpc_kaggle.reporting.figures.scores import draw_errors, draw_gains, draw_scores

__all__ = [
    "draw_budget",
    "draw_cameras",
    "draw_crops",
    "draw_errors",
    "draw_gains",
    "draw_groups",
    "draw_pair",
    "draw_parts",
    "draw_scores",
    "draw_strip",
    "draw_upgrades",
    "new_figure",
    "save",
    "to_jpeg",
    "to_svg",
]
