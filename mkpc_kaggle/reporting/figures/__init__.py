"""Figures, drawn with matplotlib: everything that this package paints is painted here.

``pair`` shows one pair at a glance, ``steps`` the method step by step, ``run`` what a run did, ``scores`` how well
recipes do; ``canvas`` is what they share.
"""

from mkpc_kaggle.reporting.figures.canvas import new_figure, save, to_jpeg, to_svg
from mkpc_kaggle.reporting.figures.pair import draw_pair, draw_strip
from mkpc_kaggle.reporting.figures.run import draw_budget, draw_crops, draw_groups, draw_parts, draw_upgrades
from mkpc_kaggle.reporting.figures.scores import draw_errors, draw_gains, draw_scores
from mkpc_kaggle.reporting.figures.steps import (
    draw_both,
    draw_boxes,
    draw_clusters,
    draw_epipolar,
    draw_images,
    draw_plane,
    draw_pose_errors,
    draw_sizes,
    draw_stage,
    draw_views,
)

__all__ = [
    "draw_both",
    "draw_boxes",
    "draw_budget",
    "draw_clusters",
    "draw_crops",
    "draw_epipolar",
    "draw_errors",
    "draw_gains",
    "draw_groups",
    "draw_images",
    "draw_pair",
    "draw_parts",
    "draw_plane",
    "draw_pose_errors",
    "draw_scores",
    "draw_sizes",
    "draw_stage",
    "draw_strip",
    "draw_upgrades",
    "draw_views",
    "new_figure",
    "save",
    "to_jpeg",
    "to_svg",
]
