"""A demo data set: rendered photographs with exact cameras, in the competition's layout.

A world is a ground, three walls and boxes, with drawn textures. Every view has a known camera and an exact depth
map, so the ground truth is exact.
"""

from mkpc_kaggle.demo.write import DemoSet, write_demo

__all__ = ["DemoSet", "write_demo"]
