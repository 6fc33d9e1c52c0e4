"""LoFTR (Sun et al. 2021), weights with dual softmax: ``outdoor_ds`` and ``indoor_ds_new``."""

from functools import partial

from mkpc_kaggle.matchers.networks.loftr import Loftr
from mkpc_kaggle.matchers.semi_dense import load_semi_dense, semi_dense_spec

SPEC = semi_dense_spec("loftr", multiple=8)
load = partial(load_semi_dense, SPEC, Loftr)
