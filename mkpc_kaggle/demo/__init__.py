"""A demo data set: synthetic scenes with exact cameras, in the competition's layout.

scikit-learn's two sample photographs and procedural materials cover planes and boxes in three small worlds.
Every view is rendered with a known camera and an exact depth map, so ground truth has no error of its own.
"""

from mkpc_kaggle.demo.camera import Camera, look_at, project, resized, unproject
from mkpc_kaggle.demo.covisibility import covisibility, visible_share
from mkpc_kaggle.demo.render import render
from mkpc_kaggle.demo.scene import Scene, View
from mkpc_kaggle.demo.scenes import SCENE_NAMES, build_scene
from mkpc_kaggle.demo.write import DemoSet, write_demo

__all__ = [
    "SCENE_NAMES",
    "Camera",
    "DemoSet",
    "Scene",
    "View",
    "build_scene",
    "covisibility",
    "look_at",
    "project",
    "render",
    "resized",
    "unproject",
    "visible_share",
    "write_demo",
]
