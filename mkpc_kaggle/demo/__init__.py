"""A demo data set: rendered photographs with known cameras, in the competition's layout.

A world consists of a ground, three walls and boxes, all with drawn textures. Every view has an
exact camera and an exact depth map, so the ground truth is exact.
"""

from mkpc_kaggle.demo.write import DemoSet, write_demo

__all__ = ["DemoSet", "write_demo"]
