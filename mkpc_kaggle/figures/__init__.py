"""Figures, drawn with matplotlib: everything that this package paints is painted here.

``pair`` shows one pair at a glance, ``steps`` the method step by step, ``run`` what a run did, ``scores`` how well
recipes do; ``canvas`` is what they share.
"""

from mkpc_kaggle.figures.canvas import new_figure, save, to_jpeg, to_svg
from mkpc_kaggle.figures.pair import draw_pair, draw_strip
from mkpc_kaggle.figures.run import draw_budget, draw_crops, draw_groups, draw_parts
from mkpc_kaggle.figures.scores import draw_errors, draw_gains, draw_scores

__all__ = [
    "draw_budget",
    "draw_crops",
    "draw_errors",
    "draw_gains",
    "draw_groups",
    "draw_pair",
    "draw_parts",
    "draw_scores",
    "draw_strip",
    "new_figure",
    "save",
    "to_jpeg",
    "to_svg",
]
