"""GPUs of a run, shown on machines without one: which are used, in which precision."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from device_double import DeviceDouble

from mkpc_kaggle.data.images import Image
from mkpc_kaggle.engine.places import Kind, LocalSite
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.contract import MatcherSpec, Precision
from mkpc_kaggle.matchers.devices import (
    fastest_precision,
    require_device,
    resolve_placement,
)
from mkpc_kaggle.matchers.dtypes import exact_float32
from mkpc_kaggle.matchers.failures import DeviceError
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.recipe import Recipe, Unit
from mkpc_kaggle.setup.assembly import assemble

UNIT = Unit(1, "own", 64)
RECIPE = Recipe((UNIT,))


def gpus_here(monkeypatch: pytest.MonkeyPatch, *capabilities: tuple[int, int]) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: len(capabilities))
    monkeypatch.setattr(torch.cuda, "get_device_capability", capabilities.__getitem__)


def test_a_missing_gpu_is_refused_and_half_precision_asks_every_gpu_that_the_run_uses(
    monkeypatch,
):
    # A T4, whose tensor cores are fast in half precision, and a P100, which has none.
    gpus_here(monkeypatch, (7, 5), (6, 0))
    assert resolve_placement("cuda:1", "float32").device == "cuda:1"
    with pytest.raises(UserError, match="--device cuda:2: this machine has 2 GPU"):
        resolve_placement("cuda:2", "float32")
    fastest = [fastest_precision(device) for device in ("cuda", "cuda:0", "cuda:1")]
    assert fastest == [Precision.FLOAT32, Precision.FLOAT16, Precision.FLOAT32]


def test_the_parent_of_workers_never_initialises_cuda(monkeypatch):
    def refuse() -> None:
        raise AssertionError("CUDA was initialised in the parent")

    # A process that has initialised CUDA holds memory on the GPU, and its forks cannot use it.
    monkeypatch.setattr(torch.cuda, "_lazy_init", refuse)
    gpus_here(monkeypatch, (7, 5), (7, 5))
    made = assemble("classical", device="cuda")
    site = LocalSite(made, None, time.monotonic)
    assert [place.name for place in site.of(Kind.MATCH)] == ["cuda:0", "cuda:1"]


def test_a_device_that_multiplies_and_cannot_convolve_is_refused(monkeypatch):
    def convolve(*_: object) -> None:
        raise RuntimeError("cuDNN error: CUDNN_STATUS_EXECUTION_FAILED_CUDART")

    # A driver that does not fit torch's build: products work, and cuDNN fails.
    with DeviceDouble(1) as double:
        require_device("cuda:0")
        assert double.operators > 0
        monkeypatch.setattr(torch.nn.functional, "conv2d", convolve)
        with pytest.raises(
            DeviceError, match=r"cuda:0 cannot be used \(RuntimeError: cuDNN error"
        ):
            require_device("cuda:0")


@dataclass(frozen=True, eq=False)
class Maps:
    coarse: torch.Tensor
    others: tuple[torch.Tensor, ...] = ()


def settings() -> tuple[str, str]:
    return torch.backends.cudnn.conv.fp32_precision, torch.backends.cuda.matmul.fp32_precision


class Own:
    """Encodes pictures as ``value`` and matches nothing; notes how GPUs were to compute."""

    spec = MatcherSpec("own")

    def __init__(self, value: float) -> None:
        self.value = value
        self.seen = []
        self.encoded = 0

    def encode(self, pictures: Any) -> list[Maps]:
        self.seen.append(settings())
        self.encoded += len(pictures)
        return [Maps(torch.full((4,), self.value)) for _ in pictures]

    def match(self, encodings0: Any, encodings1: Any) -> list[Matches]:
        self.seen.append(settings())
        return [Matches.empty() for _ in encodings0]


def works() -> list[PairMatch]:
    # Two pairs with a common first image, which is encoded once.
    rows = np.random.default_rng(0).integers(0, 255, (3, 48, 64, 3), np.uint8)
    images = [Image.of_array(pixels) for pixels in rows]
    return [PairMatch(images=(images[0], other)) for other in images[1:]]


@pytest.mark.skipif(
    not hasattr(torch.backends.cudnn, "conv"),
    reason="PyTorch before 2.9 has other names for it",
)
def test_matchers_run_without_tf32_and_the_process_keeps_its_settings():
    before = settings()
    own = Own(1.0)
    Pipeline(RECIPE, lambda name: own).match(works(), RECIPE.units)
    # TF32 has ten bits of mantissa; matches would depend on the GPU.
    assert set(own.seen) == {("ieee", "ieee")}
    assert settings() == before
    with pytest.raises(ZeroDivisionError), exact_float32():
        raise ZeroDivisionError
    assert settings() == before


def test_features_that_are_not_finite_load_the_matcher_in_float32_and_are_an_error_there():
    half = Own(float("inf"))
    exact = Own(1.0)
    runner = Pipeline(RECIPE, lambda name: half, load_float32=lambda name: exact)
    with pytest.warns(RuntimeWarning, match="own runs in float32"):
        done = runner.match(works(), RECIPE.units)
    assert (half.encoded, exact.encoded) == (1, 3)
    note = "own runs in float32, for in half precision features of own are not finite"
    assert {(work.results[0].failure, work.results[0].note) for work in done} == {("", note)}
    failed = Pipeline(RECIPE, lambda name: Own(float("nan"))).match(works(), RECIPE.units)
    failures = {work.results[0].failure for work in failed}
    assert failures == {"NonFiniteError: features of own are not finite"}
