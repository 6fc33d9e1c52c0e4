"""ASpanFormer (Chen et al. 2022). Its weights are for noncommercial use."""

from functools import partial

from mkpc_kaggle.matchers.networks.aspanformer import AspanFormer
from mkpc_kaggle.matchers.semi_dense import load_semi_dense, semi_dense_spec

SPEC = semi_dense_spec("aspanformer", AspanFormer)
# Checkpoints also have offsets that the published network does not use.
load = partial(load_semi_dense, SPEC, AspanFormer, unused=r".*\.sample_offset$")
