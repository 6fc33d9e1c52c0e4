"""Golden vectors of ``../shared/golden``; tests that need them are skipped without them."""

import re
import runpy
import sys
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
import pytest
import torch
from shared import SHARED

from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.networks.placement import prepared

GOLDEN = SHARED / "golden"

needs_golden = pytest.mark.skipif(
    not GOLDEN.is_dir(), reason=f"no golden vectors in {GOLDEN}"
)


def golden_arrays(network, case):
    """The arrays of one file by their names, as tensors where they hold numbers, else as text."""
    with np.load(GOLDEN / network / f"{case}.npz") as file:
        arrays = {name: file[name] for name in file}
    kinds = {True: str, False: torch.from_numpy}
    return {name: kinds[array.dtype.kind == "U"](array) for name, array in arrays.items()}


@cache
def recipe(path):
    """The names that a recipe of weights defines; it puts its own folder on the path, which is
    taken off again.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [*sys.path])
        return runpy.run_path(str(path))


@lru_cache(maxsize=1)  # the largest have a gigabyte
def standin_state(network, *which, **part):
    """The stand-in checkpoint that the folder's ``standin.py`` makes, or that part of it, as
    tensors.
    """
    values = recipe(GOLDEN / network / "standin.py")["standin_state_dict"](*which, **part)
    return {name: torch.from_numpy(np.asarray(value)) for name, value in values.items()}


def seeded_tensor(name, shape, gain=1.0):
    return torch.from_numpy(
        recipe(GOLDEN / "seeded_weights.py")["seeded_tensor"](name, shape, gain)
    )


@contextmanager
def recorded(network, name):
    """A list that fills with the inputs and the output of each call of that module."""
    calls = []
    hook = network.get_submodule(name).register_forward_hook(
        lambda _, *call: calls.append(call)
    )
    yield calls
    hook.remove()


def ready(network, state):
    network.load_state_dict(state, strict=True)
    return prepared(network.eval(), Placement())


@dataclass(frozen=True)
class Within:
    """The allowed difference: a number, plus a part of each value, plus a part of the largest
    value.
    """

    absolute: float = 0.0
    relative: float = 0.0
    share: float = 0.0

    def of(self, expected):
        sizes = expected.double().abs()
        largest = sizes.max() if sizes.numel() else 0
        return self.absolute + self.relative * sizes + self.share * largest


class Stage(NamedTuple):
    """The value that a network computed at one stage, the expected value, and their allowed
    difference.
    """

    name: str
    got: torch.Tensor
    expected: torch.Tensor
    within: float | Within = 0.0

    @property
    def excess(self):
        """Return by how much the difference exceeds the allowed one: infinite for other shapes,
        kinds, or NaN.
        """
        got = self.got
        expected = self.expected
        alike = (
            got.shape == expected.shape
            and got.is_floating_point() == expected.is_floating_point()
        )
        if not alike or not got.isfinite().all():
            return float("inf")
        within = self.within if isinstance(self.within, Within) else Within(self.within)
        excess = (got.double() - expected.double()).abs() - within.of(expected)
        return excess.max().item() if got.numel() else 0.0


def compared(values, golden, tolerances, suffix=""):
    """Yield a stage for each value that the golden file has; batches of one may have no axis there.

    Tolerances are by patterns of names; of others the difference must be 0.
    """
    names = [name for name in values if f"{name}{suffix}" in golden]
    assert len(names) >= 2  # names that do not agree would compare nothing
    for name in names:
        expected = golden[f"{name}{suffix}"]
        fitting = [value for pattern, value in tolerances.items() if re.match(pattern, name)]
        within = fitting[0] if fitting else 0.0
        yield Stage(f"{name}{suffix}", values[name].reshape(expected.shape), expected, within)


def in_order(rows):
    """Return the rows (N, D) in lexicographic order, for choices whose order does not count."""
    return torch.tensor(sorted(rows.tolist()))


def assert_stages(stages):
    """All stages within their tolerances; the message starts with the first stage that is off."""
    off = [stage for stage in stages if stage.excess > 0]
    assert not off, "; ".join(
        f"{stage.name} exceeds its tolerance by {stage.excess:.2g}" for stage in off
    )
