"""Every network against golden files of its reference.

A row of ``CASES`` is a network with a golden file. Its function yields the stages with their
tolerances.
"""

import dense_stages
import loma_stages
import pytest
import semi_dense_stages
import sparse_stages
import torch
from golden import assert_stages, needs_golden

# Parity is of arithmetic: stand-in weights of a seed show it as well as trained ones.
CASES = sparse_stages.CASES | semi_dense_stages.CASES | dense_stages.CASES | loma_stages.CASES


@needs_golden
@pytest.mark.parametrize("stages", CASES.values(), ids=CASES)
@torch.inference_mode()
def test_every_stage_agrees_with_the_golden_file(stages):
    assert_stages(stages())
