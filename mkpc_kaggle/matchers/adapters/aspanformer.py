"""ASpanFormer (Chen et al. 2022). Its weights are for noncommercial use."""

from functools import partial

from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.semi_dense import load_semi_dense, semi_dense_spec

SPEC = semi_dense_spec("aspanformer", multiple=32)
load = partial(load_semi_dense, SPEC, AspanFormer)
