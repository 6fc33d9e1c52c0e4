"""LoFTR with QuadTree attention (Tang et al. 2022)."""

from functools import partial

from mkpc_kaggle.matchers.networks.quadtree import Quadtree
from mkpc_kaggle.matchers.semi_dense import load_semi_dense, semi_dense_spec

SPEC = semi_dense_spec("quadtree", multiple=32)
load = partial(load_semi_dense, SPEC, Quadtree)
