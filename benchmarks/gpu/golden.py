"""The networks on the device against golden vectors of their references, stage by stage.

The tests of parity (``tests/parity``) compute on the CPU. Here, each of their networks is on the
device: its inputs are moved there, and its outputs back.
"""

import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn

from benchmarks.gpu.record import EXPECTED, Part, SkippedError
from benchmarks.gpu.setup import Setup
from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.dtypes import exact_float32
from mkpc_kaggle.matchers.networks.placement import prepared

ROOT = Path(__file__).resolve().parents[2]
MODULES = ("sparse_stages", "semi_dense_stages", "loma_stages", "dense_stages")  # RoMa is last
QUICK = ("superpoint noborder_64x72", "superglue tiny_1x3")


def measure(part: Part, setup: Setup) -> None:
    """Add a row for each case: its stages, and the stages outside their tolerances."""
    if setup.golden is None or not setup.golden.is_dir():
        where = "--golden DIR or MKPC_SHARED names them"
        raise SkippedError(f"no golden vectors in {setup.golden}; {where}")
    for folder in ("support", "parity"):
        sys.path.append(str(ROOT / "tests" / folder))
    with networks_on(setup.device, setup.golden) as cases:
        for name, stages in cases.items():
            if setup.quick and name not in QUICK:
                continue
            part.check_time(needed=5.0 if setup.is_gpu else 0.0)
            with part.row(case=name) as row, torch.inference_mode(), exact_float32():
                row.update(_compare(stages))


def _compare(stages: Callable[[], Iterator[Any]]) -> dict[str, Any]:
    try:
        excess = {stage.name: stage.excess for stage in stages()}
    except FileNotFoundError as error:
        raise SkippedError(f"{Path(error.filename).name} is missing") from error
    off = {name: value for name, value in excess.items() if value > 0}
    row: dict[str, Any] = {"stages": len(excess), "outside": len(off)}
    # The first one explains those after it.
    row["first outside, by"] = next((f"{name} {value:.2g}" for name, value in off.items()), "")
    row["verdict"] = "differs from the reference" if off else EXPECTED
    return row


@contextmanager
def networks_on(device: str, golden: Path) -> Iterator[dict[str, Callable[[], Iterator[Any]]]]:
    """Yield the cases of the tests of parity by name, with their networks on the device."""
    support = importlib.import_module("golden")
    modules = [importlib.import_module(name) for name in MODULES]

    def ready(network: nn.Module, state: dict[str, Tensor]) -> Any:
        network.load_state_dict(state, strict=True)
        return OnDevice(prepared(network.eval(), Placement(device)), device)

    def prepared_there(network: nn.Module, _: Placement) -> Any:
        return OnDevice(prepared(network, Placement(device)), device)

    stand_ins = {"ready": ready, "prepared": prepared_there, "recorded": recorded}
    with ExitStack() as patched:
        for module in [support, *modules]:
            for name, value in {**stand_ins, "GOLDEN": golden}.items():
                if hasattr(module, name):
                    patched.enter_context(patch.object(module, name, value))
        yield {name: stages for module in modules for name, stages in module.CASES.items()}


class OnDevice:
    """A module on a device that takes tensors of the CPU, and returns them.

    Its submodules and methods do so, too.
    """

    def __init__(self, module: nn.Module, device: str) -> None:
        vars(self).update(_module=module, _device=device)

    def __getattr__(self, name: str) -> Any:
        return self._shown(getattr(self._module, name))

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._module, name, value)

    def __delattr__(self, name: str) -> None:
        delattr(self._module, name)

    def __call__(self, *args: Any, **named: Any) -> Any:
        return self._called(self._module, args, named)

    def __iter__(self) -> Iterator[Any]:
        return iter(self._module)  # the names of a ModuleDict

    def _shown(self, value: Any) -> Any:
        if isinstance(value, nn.Module):
            return OnDevice(value, self._device)
        if callable(value) and not isinstance(value, type):
            return lambda *args, **named: self._called(value, args, named)
        return moved(value, "cpu")

    def _called(self, function: Any, args: Any, named: Any) -> Any:
        result = function(*moved(args, self._device), **moved(named, self._device))
        return (
            OnDevice(result, self._device)
            if isinstance(result, nn.Module)
            else moved(result, "cpu")
        )


def moved(value: Any, device: str) -> Any:
    """Return a value with all its tensors on the device."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {name: moved(item, device) for name, item in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(moved(item, device) for item in value))
    if isinstance(value, tuple | list):
        return type(value)(moved(item, device) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        items = {field.name: moved(getattr(value, field.name), device) for field in fields(value)}
        return replace(value, **items)
    return value


@contextmanager
def recorded(network: OnDevice, name: str) -> Iterator[list[Any]]:
    """Yield a list that fills with the inputs and the output of each call, on the CPU."""
    calls: list[Any] = []
    module: nn.Module = network._module.get_submodule(name)
    hook = module.register_forward_hook(lambda _, *call: calls.append(moved(call, "cpu")))
    yield calls
    hook.remove()
