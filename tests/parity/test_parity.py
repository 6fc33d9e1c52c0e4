"""Every network against golden files of its reference; the parameters of the published files.

A row of ``CASES`` is a network with a golden file. Its function yields the stages with their tolerances.
"""

import json
import re

import dense_stages
import loma_stages
import pytest
import semi_dense_stages
import sparse_stages
import torch
from golden import GOLDEN, assert_stages, needs_golden

from mkpc_kaggle.matchers.networks.loma import UNUSED, Loma, Variant, parameter_name
from mkpc_kaggle.matchers.networks.roma import RoMa

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


def published(network):
    """Return the shapes of the parameters that a network's published files have and inference uses."""
    shapes = json.loads((GOLDEN / ("roma" if network is RoMa else "loma") / "shapes.json").read_text())
    if network is RoMa:
        return {f"dinov2.{name}": shape for name, shape in shapes["dinov2"].items()} | shapes["roma"]
    name = network.upper()
    every = shapes["B128"] if name == "B128" else shapes["B"] | shapes.get(name, {})
    used = {parameter_name(name): shape for name, shape in every.items()}
    return {name: shape for name, shape in used.items() if not re.match(UNUSED, name)}


@needs_golden
@pytest.mark.parametrize("network", [RoMa, *Variant])
def test_the_published_files_have_the_networks_parameters_and_no_others(network):
    with torch.device("meta"):
        made = RoMa() if network is RoMa else Loma(network)
    assert {name: list(tensor.shape) for name, tensor in made.state_dict().items()} == published(network)
