"""Tensors come out of every kind of checkpoint, and nothing in it runs."""

import contextlib
import operator
import os
import pickle
import types
from collections import OrderedDict
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from torch import nn
from weight_files import put

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights import load_into, load_tensors

# A matrix, a scalar and an empty tensor: formats store each in its own way.
TENSORS = {
    "a.weight": torch.arange(6.0).reshape(2, 3),
    "a.count": torch.tensor(7),
    "b": torch.zeros(0),
}
save_legacy = partial(torch.save, _use_new_zipfile_serialization=False)


def save_pickle(value: object, path: Path) -> None:
    path.write_bytes(pickle.dumps(value, protocol=2))


def assert_same(loaded: dict[str, torch.Tensor], wanted: dict[str, torch.Tensor]) -> None:
    assert set(loaded) == set(wanted)
    for name, tensor in wanted.items():
        assert loaded[name].dtype == tensor.dtype
        assert not loaded[name].requires_grad
        assert torch.equal(loaded[name], tensor)


@pytest.mark.parametrize("save", [torch.save, save_legacy, save_file])
def test_every_file_format_gives_the_same_plain_tensors(tmp_path, save):
    path = tmp_path / ("x.safetensors" if save is save_file else "x.pt")
    save(TENSORS, path)
    assert_same(load_tensors(path), TENSORS)


PARALLEL = {f"module.{name}": tensor for name, tensor in TENSORS.items()}


@pytest.mark.parametrize("save", [torch.save, save_legacy])
@pytest.mark.parametrize(
    "value",
    [
        {"state_dict": TENSORS, "epoch": 3},
        {"extractor": TENSORS},
        {"model": {"state_dict": PARALLEL}, "epoch": 3},
        {name: nn.Parameter(value, requires_grad=False) for name, value in TENSORS.items()},
    ],
    ids=["wrapper", "DISK", "wrappers and parallel training", "parameters"],
)
def test_wrappers_and_prefixes_of_trainings_are_removed(tmp_path, value, save):
    save(value, tmp_path / "x.pt")
    assert_same(load_tensors(tmp_path / "x.pt"), TENSORS)


def test_a_part_of_a_network_may_be_called_module(tmp_path):
    mixed = PARALLEL | {"head": torch.zeros(1)}
    torch.save(mixed, tmp_path / "y.pt")
    assert_same(load_tensors(tmp_path / "y.pt"), mixed)


@pytest.mark.parametrize("save", [torch.save, save_legacy])
@pytest.mark.parametrize(
    "value", [torch.ones(2), [torch.ones(2)], {"state_dict": 3}, {3: torch.ones(2)}]
)
def test_anything_but_a_table_of_named_tensors_is_refused(tmp_path, save, value):
    save(value, tmp_path / "x.pt")
    with pytest.raises(UserError, match=r"x\.pt cannot be read as a checkpoint: .*"):
        load_tensors(tmp_path / "x.pt")


def cut_off(save: Any) -> bytes:
    path = Path("whole.safetensors" if save is save_file else "whole.pt")
    save(TENSORS, path)
    return path.read_bytes()[:-20]


@pytest.mark.parametrize("name", ["x.pt", "x.safetensors"])
@pytest.mark.parametrize("kind", ["empty", "text", "zeros", "cut off", "missing", "folder"])
def test_a_file_that_is_not_a_checkpoint_is_refused_by_name(
    tmp_path, monkeypatch, name, kind
):
    monkeypatch.chdir(tmp_path)
    save = save_file if name.endswith("safetensors") else torch.save
    data = {"empty": b"", "text": b"<html>log in</html>", "zeros": b"\0" * 100}
    if kind == "folder":
        (tmp_path / name).mkdir()
    elif kind != "missing":
        put(
            tmp_path,
            name,
            data.get(kind) or cut_off(save) if kind == "cut off" else data[kind],
        )
    with pytest.raises(UserError, match=rf"{name} cannot be read as a checkpoint"):
        load_tensors(tmp_path / name)


class Call:
    """Pickled, it is a call of any function."""

    def __init__(self, *reduced, **state):
        self.reduced = (reduced[0], reduced[1:], *state.values())

    def __reduce__(self) -> Any:
        return self.reduced


def nasty(sentinel: Path) -> dict[str, object]:
    """Calls that would make the sentinel file, by the names that they use."""
    command = f"touch {sentinel}"
    hidden = sentinel.with_name("hidden.pt")
    hidden.write_bytes(pickle.dumps(Call(os.system, command), protocol=2))
    return {
        "os.system": Call(os.system, command),
        "builtins.eval": Call(eval, f"__import__('pathlib').Path({str(sentinel)!r}).touch()"),
        # By names that no list of forbidden functions has.
        "builtins.getattr": Call(
            operator.call, Call(getattr, Call(__import__, "os"), "system"), command
        ),
        "torch.load": Call(torch.load, str(hidden), "cpu", Call(__import__, "pickle")),
        "state": Call(types.SimpleNamespace, state={"x": Call(os.system, command)}),
        "rebuild": Call(
            torch._utils._rebuild_parameter, Call(os.system, command), False, OrderedDict()
        ),
    }


@pytest.mark.parametrize("save", [torch.save, save_legacy, save_pickle])
def test_a_pickle_that_runs_code_is_refused_by_name_and_runs_nothing(tmp_path, save):
    sentinel = tmp_path / "sentinel"
    for name, bomb in nasty(sentinel).items():
        path = tmp_path / f"{name}.pt"
        beside = {"state_dict": TENSORS, "callbacks": [{(1, 2): bomb}]}
        for value in (bomb, {"state_dict": {**TENSORS, "x": bomb}}, beside):
            save(value, path)
            with pytest.raises(
                UserError, match=rf"{name}\.pt cannot be read as a checkpoint"
            ):
                load_tensors(path)
            assert not sentinel.exists(), name
        # Proof that the bombs are live: pickle itself runs them. Some fail after they have run.
        with contextlib.suppress(Exception):
            pickle.loads(pickle.dumps(bomb, protocol=2))
        assert sentinel.exists(), name
        sentinel.rmdir() if sentinel.is_dir() else sentinel.unlink()


@settings(max_examples=100)
@given(
    st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=3)
)
def test_a_damaged_file_gives_tensors_or_a_refusal(tmp_path_factory, changes):
    path = tmp_path_factory.mktemp("fuzz") / "x.pt"
    torch.save(TENSORS, path)
    changed = bytearray(path.read_bytes())
    for place, byte in changes:
        changed[place % len(changed)] = byte
    path.write_bytes(changed)
    try:
        assert all(isinstance(tensor, torch.Tensor) for tensor in load_tensors(path).values())
    except UserError as refusal:
        assert "x.pt cannot be read as a checkpoint" in str(refusal)


def test_a_network_takes_files_in_half_precision_and_no_other_names_or_shapes():
    network = nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2))
    state = dict(network.state_dict())
    half = {name: tensor.half() for name, tensor in state.items()}
    del half["1.num_batches_tracked"]  # files of old versions of torch have none
    load_into(network, half, what="slot")
    assert network[0].weight.dtype == torch.float32
    for change, says in (
        ({"0.weight": torch.zeros(2, 4)}, "size mismatch for 0.weight"),
        ({"head": torch.zeros(1)}, 'Unexpected key.* "head"'),
    ):
        with pytest.raises(
            UserError, match=f"weights for 'slot' do not fit the network: .*{says}"
        ):
            load_into(network, state | change, what="slot")
    with pytest.raises(UserError, match=r'Missing key.* "0\.bias"'):
        load_into(
            network, {name: state[name] for name in state if name != "0.bias"}, what="slot"
        )
    load_into(network, state | {"head": torch.zeros(1)}, what="slot", unused="head$")
