"""Every network against golden files of its reference.

A row of ``CASES`` is a network with a golden file. Its function yields the stages with their tolerances.
"""

import dense_stages
import loma_stages
import pytest
import semi_dense_stages
import sparse_stages
import torch
from golden import assert_stages, needs_golden

FAST = sparse_stages.CASES | semi_dense_stages.CASES | dense_stages.CASES | loma_stages.CASES
CASES = [pytest.param(stages, id=name) for name, stages in FAST.items()]
CASES += [pytest.param(stages, id=name, marks=pytest.mark.slow) for name, stages in loma_stages.SLOW.items()]


@pytest.fixture
def one_thread():
    """Compute as the golden files were made: the split of work among threads changes the rounding.

    The golden files' own rounding takes up to 0.7 of the tolerance at RoMa's stride 1.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@needs_golden
@pytest.mark.parametrize("stages", CASES)
@torch.inference_mode()
def test_every_stage_is_the_golden_one(stages, one_thread):
    assert_stages(stages())
