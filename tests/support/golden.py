"""Golden vectors beside the repository, ``../shared/golden``; tests that need them are skipped without them."""

import importlib.util
import sys
from collections.abc import Iterable
from contextlib import contextmanager
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pytest
import torch
from shared import SHARED

from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.networks.placement import prepared

GOLDEN = SHARED / "golden"

needs_golden = pytest.mark.skipif(not GOLDEN.is_dir(), reason=f"no golden vectors in {GOLDEN}")


def golden_arrays(network, case):
    """The arrays of one file by their names, as tensors where they hold numbers, else as text."""
    with np.load(GOLDEN / network / f"{case}.npz") as file:
        arrays = {name: file[name] for name in file}
    return {
        name: str(array) if array.dtype.kind == "U" else torch.from_numpy(array) for name, array in arrays.items()
    }


@lru_cache(maxsize=1)  # the largest have a gigabyte
def standin_state(network, *which, **part):
    """The stand-in checkpoint that the folder's ``standin.py`` makes, or that part of it, as tensors."""
    recipe = _module(GOLDEN / network / "standin.py")
    return {
        name: torch.from_numpy(np.asarray(value))
        for name, value in recipe.standin_state_dict(*which, **part).items()
    }


def seeded_tensor(name, shape, gain=1.0):
    """The stand-in value of one parameter, for the folders without a ``standin.py``."""
    return torch.from_numpy(_module(GOLDEN / "seeded_weights.py").seeded_tensor(name, shape, gain))


@contextmanager
def recorded(network, names):
    """Lists by module name, which fill with the inputs and the output of each call of these modules."""
    calls = {name: [] for name in names}
    hooks = [
        network.get_submodule(name).register_forward_hook(
            lambda _module, inputs, output, calls=calls[name]: calls.append((inputs, output))
        )
        for name in names
    ]
    try:
        yield calls
    finally:
        for hook in hooks:
            hook.remove()


def ready(network, state):
    """The network with these weights as it runs, its batch norms folded."""
    network.load_state_dict(state, strict=True)
    return prepared(network.eval(), Placement())


def _module(path):
    before = list(sys.path)
    try:  # a recipe puts its own folder on the path
        spec = importlib.util.spec_from_file_location(f"golden_{path.parent.name}_{path.stem}", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path[:] = before
    return module


class Stage(NamedTuple):
    """What a network computed at one stage, what it should be, and by how much they may differ at most."""

    name: str
    got: torch.Tensor
    expected: torch.Tensor
    tolerance: float = 0

    @property
    def difference(self):
        """Infinite if shapes or kinds differ or a value is not finite."""
        got, expected = self.got, self.expected
        alike = got.shape == expected.shape and got.is_floating_point() == expected.is_floating_point()
        if not alike or not got.isfinite().all():
            return float("inf")
        return (got.double() - expected.double()).abs().max().item() if got.numel() else 0.0


def assert_stages(stages: Iterable[Stage]):
    """All stages within their tolerances; the message starts with the first stage that is off."""
    off = [stage for stage in stages if stage.difference > stage.tolerance]
    assert not off, "; ".join(f"{stage.name} is off by {stage.difference:.2g}" for stage in off)


def tolerance_of(name, tolerances):
    """Return the tolerance of the entry's prefix, 0 if it has none: then it must agree exactly."""
    return next((tolerance for prefix, tolerance in tolerances.items() if name.startswith(prefix)), 0.0)


def compared(values, golden, tolerances):
    """Yield a stage for each value that the golden file has."""
    names = [name for name in values if name in golden]
    assert len(names) >= 2
    yield from (
        Stage(name, values[name].reshape(golden[name].shape), golden[name], tolerance_of(name, tolerances))
        for name in names
    )
