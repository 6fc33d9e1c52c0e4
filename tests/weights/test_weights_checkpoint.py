"""Tensors come out of every kind of checkpoint, and nothing in it runs; checkpoints as safetensors."""

import contextlib
import operator
import os
import pickle
import sys
import types
import zipfile
from argparse import Namespace
from collections import Counter, OrderedDict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from torch import nn
from weight_files import digest_of, put

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights import checkpoint, load_tensors
from mkpc_kaggle.weights.checkpoint import convert_file
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile
from mkpc_kaggle.weights.store import judge

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
    assert list(loaded) == list(wanted)
    for name, tensor in wanted.items():
        found = loaded[name]
        assert found.dtype == tensor.dtype
        assert found.stride() == tensor.stride()
        assert not found.requires_grad
        assert torch.equal(found, tensor)


@pytest.mark.parametrize(
    ("save", "wrapped"),
    [(torch.save, 0), (torch.save, 1), (save_legacy, 0), (save_legacy, 1), (save_file, 0)],
)
def test_every_file_format_gives_the_same_plain_tensors(tmp_path, save, wrapped):
    path = tmp_path / ("x.safetensors" if save is save_file else "x.pt")
    save({"state_dict": TENSORS, "epoch": 3} if wrapped else TENSORS, path)
    loaded = load_tensors(path)
    assert_same({name: loaded[name] for name in TENSORS}, TENSORS)


@pytest.mark.parametrize("save", [torch.save, save_legacy, save_file])
def test_on_the_device_meta_a_file_gives_names_shapes_and_types(tmp_path, save):
    path = tmp_path / ("x.safetensors" if save is save_file else "x.pt")
    save(TENSORS, path)
    # So that a file is tried in its network without memory.
    with torch.device("meta"):
        loaded = load_tensors(path, "meta")
    assert {name: loaded[name].device.type for name in loaded} == dict.fromkeys(TENSORS, "meta")
    expected = {name: (tensor.shape, tensor.dtype) for name, tensor in TENSORS.items()}
    assert {name: (tensor.shape, tensor.dtype) for name, tensor in loaded.items()} == expected


@pytest.mark.parametrize("wrapper", ["state_dict", "extractor", "model"])
def test_tensors_in_a_wrapper_are_found(tmp_path, wrapper):
    torch.save({wrapper: TENSORS, "epoch": 3}, tmp_path / "x.pt")
    assert_same(load_tensors(tmp_path / "x.pt"), TENSORS)


def test_wrappers_in_wrappers_and_the_prefix_of_parallel_training_are_removed(tmp_path):
    parallel = {f"module.{name}": tensor for name, tensor in TENSORS.items()}
    torch.save({"model": {"state_dict": parallel}, "epoch": 3}, tmp_path / "x.pt")
    assert_same(load_tensors(tmp_path / "x.pt"), TENSORS)
    # Of one network, "module" may be a part.
    mixed = parallel | {"head": torch.zeros(1)}
    torch.save(mixed, tmp_path / "y.pt")
    assert list(load_tensors(tmp_path / "y.pt")) == list(mixed)


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 123456\n"
PAGE = b"\n<!DOCTYPE html><html><title>Sign in</title></html>"


@pytest.mark.parametrize(("data", "named"), [(LFS, "pointer of Git LFS"), (PAGE, "a web page")])
@pytest.mark.parametrize("size", [-1, 123456])
def test_a_pointer_or_a_page_in_the_place_of_a_file_is_named(tmp_path, data, named, size):
    for name in ("x.pth", "x.safetensors"):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(UserError, match=f"cannot be read as a checkpoint: it is .*{named}"):
            load_tensors(tmp_path / name)
    line = WeightFile("x.pth", size, f"sha256:{'0' * 64}", "MIT", "x", "here")
    found = judge(tmp_path / "x.pth", line, [line])
    assert found.state == "refused"
    assert named in found.note


@pytest.mark.timeout(60)
def test_a_pipe_in_the_place_of_a_file_is_refused_and_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "x.pt")
    with pytest.raises(UserError, match="not a regular file"):
        load_tensors(tmp_path / "x.pt")


@pytest.mark.filterwarnings("ignore::UserWarning")  # of torch, on prototypes
@pytest.mark.parametrize("save", [torch.save, save_legacy])
def test_anything_but_a_table_of_plain_tensors_is_refused(tmp_path, save):
    ones = torch.ones(2, 3)
    base = torch.zeros(10_000)
    odd = [
        ones,
        [ones],
        {"state_dict": 3},
        {3: ones},
        {"x": ones.to_sparse()},
        {"x": ones.to_sparse_csr()},
        {"x": ones.to("meta")},
        {"x": torch.quantize_per_tensor(ones, 0.1, 0, torch.quint8)},
        {"x": torch.nested.nested_tensor([ones[0], ones[1, :2]])},
        # A few bytes that unpack to megabytes.
        {"x": torch.zeros(1).expand(1_000_000)},
        {str(n): base for n in range(100)},
    ]
    for value in odd:
        save(value, tmp_path / "x.pt")
        with pytest.raises(UserError, match=r"x\.pt cannot be read as a checkpoint: .*"):
            load_tensors(tmp_path / "x.pt")
    save({str(number): base for number in range(3)}, tmp_path / "x.pt")
    assert len(load_tensors(tmp_path / "x.pt")) == 3, "tensors may share their bytes"


@pytest.mark.parametrize("name", ["x.pt", "x.safetensors"])
@pytest.mark.parametrize("data", [b"", b"no checkpoint", b"\0" * 100])
def test_a_file_that_is_not_a_checkpoint_is_refused_by_name(tmp_path, name, data):
    put(tmp_path, name, data)
    with pytest.raises(UserError, match=rf"{name} cannot be read as a checkpoint"):
        load_tensors(tmp_path / name)


# As PyTorch Lightning's checkpoints of LoFTR and others: callbacks and options of missing classes.
FRAMEWORK = """
class Checkpoint:
    def __init__(self): self.best, self.kind = {"score": 0.5}, Slotted()
    def __setstate__(self, state): raise SystemError("this must not run")
class Slotted:
    __slots__ = ("x",)
    def __init__(self): self.x = 1
def schedule(epoch): ...
"""


@pytest.fixture
def framework(monkeypatch):
    """A training framework that is missing when the checkpoint is read."""
    module = types.ModuleType("training_framework")
    exec(FRAMEWORK, module.__dict__)
    monkeypatch.setitem(sys.modules, "training_framework", module)
    return module


def training_checkpoint(
    framework: types.ModuleType, state: dict[str, torch.Tensor]
) -> dict[str, Any]:
    return {
        "epoch": 3,
        "pytorch-lightning_version": "1.3.5",
        "callbacks": {
            framework.Checkpoint: framework.Checkpoint(),
            "sizes": {1, 2},
            "z": 1 + 2j,
            "b": b"x",
        },
        "optimizer_states": [{"state": {0: {"step": 3, "mean": torch.ones(2)}}}],
        "hyper_parameters": Namespace(a=[1, 2], b=framework.schedule),
        "lr_schedulers": [{"milestones": Counter([8, 12, 12])}],
        "misc": [
            framework.Slotted(),
            torch.float32,
            torch.Size([2]),
            torch.device("cpu"),
            Path("/x"),
        ],
        "state_dict": state,
    }


def test_a_training_checkpoint_with_unknown_classes_gives_its_tensors_but_not_in_the_old_format(
    tmp_path, framework
):
    base = torch.arange(24.0).reshape(4, 6)
    network = nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2))
    state = OrderedDict(network.state_dict())
    state |= {
        "shared": base,
        "columns": base.t(),
        "strided": base[::2, 1::3],
        "empty": torch.zeros(0, 3),
    }
    state["parameter"] = nn.Parameter(torch.ones(3))
    state["complex"] = torch.tensor([1 + 2j])
    for dtype in (torch.bfloat16, torch.float16, torch.int64, torch.uint8, torch.bool):
        state[f"{dtype}"] = torch.tensor([[0, 1, 1], [1, 0, 0]]).to(dtype)
    assert hasattr(network.state_dict(), "_metadata")
    torch.save(training_checkpoint(framework, state), tmp_path / "x.ckpt")
    save_legacy(training_checkpoint(framework, TENSORS), tmp_path / "old.ckpt")
    del sys.modules["training_framework"]
    # torch refuses the file for its unknown classes, which the package maps to an inert one.
    with pytest.raises(pickle.UnpicklingError):
        torch.load(tmp_path / "x.ckpt", weights_only=True)
    loaded = load_tensors(tmp_path / "x.ckpt")
    assert_same(loaded, {name: tensor.detach() for name, tensor in state.items()})
    with pytest.raises(UserError, match=r"old\.ckpt .* contains unsupported objects"):
        load_tensors(tmp_path / "old.ckpt")


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
        "os.mkdir": Call(os.mkdir, str(sentinel)),
        # By names that no list of forbidden functions has.
        "builtins.getattr": Call(
            operator.call, Call(getattr, Call(__import__, "os"), "system"), command
        ),
        "torch.load": Call(torch.load, str(hidden), "cpu", Call(__import__, "pickle")),
        "torch.save": Call(torch.save, 1, str(sentinel)),
        "state": Call(types.SimpleNamespace, state={"x": Call(os.system, command)}),
        "rebuild": Call(
            torch._utils._rebuild_parameter, Call(os.system, command), False, OrderedDict()
        ),
    }


@pytest.mark.parametrize("save", [torch.save, save_legacy, save_pickle])
def test_a_malicious_pickle_runs_nothing(tmp_path, save):
    sentinel = tmp_path / "sentinel"
    for name, bomb in nasty(sentinel).items():
        path = tmp_path / f"{name}.pt"
        beside = {"state_dict": TENSORS, "callbacks": [{(1, 2): bomb}]}
        for value in (bomb, {"state_dict": {**TENSORS, "x": bomb}}, beside):
            save(value, path)
            try:
                assert_same(load_tensors(path), TENSORS)
            except UserError as refusal:
                assert path.name in str(refusal)
            assert not sentinel.exists(), name
        # Proof that the bombs are live: pickle itself runs them. Some fail after they have run.
        with contextlib.suppress(Exception):
            pickle.loads(pickle.dumps(bomb, protocol=2))
        assert sentinel.exists(), name
        sentinel.rmdir() if sentinel.is_dir() else sentinel.unlink()


def with_pickle(path: Path, change: Callable[[bytes], bytes]) -> Path:
    """A checkpoint as torch writes it, with an unknown object and a changed pickle."""
    torch.save({"state_dict": TENSORS, "options": Namespace()}, path)
    with zipfile.ZipFile(path) as archive:
        records = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, record in records.items():
            archive.writestr(name, change(record) if name.endswith("/data.pkl") else record)
    return path


def test_records_that_unpack_to_more_than_the_file_or_overlap_are_refused(tmp_path):
    path = with_pickle(tmp_path / "x.pt", bytes)
    assert load_tensors(path).keys() == TENSORS.keys()
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x/big", bytes(1_000_000))
    # torch writes no compressed record: one that is compressed may unpack to any size.
    says = r"x\.pt cannot be read .* records are compressed or overlap"
    with pytest.raises(UserError, match=says):
        load_tensors(path)
    with_pickle(path, bytes)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("x/big", bytes(20_000))
        # Two names of the same bytes, as in zip bombs that are not compressed.
        big = archive.getinfo("x/big")
        same = archive.infolist()[0]
        same.header_offset = big.header_offset
        same.CRC = big.CRC
        same.file_size = 20_000
        same.compress_size = 20_000
    with pytest.raises(UserError, match="compressed or overlap"):
        load_tensors(path)


@settings(max_examples=100)
@given(st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=3))
def test_a_damaged_pickle_gives_tensors_or_a_refusal(tmp_path_factory, changes):
    def damaged(data: bytes) -> bytes:
        changed = bytearray(data)
        for place, byte in changes:
            changed[place % len(data)] = byte
        return bytes(changed)

    path = with_pickle(tmp_path_factory.mktemp("fuzz") / "x.pt", damaged)
    try:
        assert all(isinstance(tensor, torch.Tensor) for tensor in load_tensors(path).values())
    except UserError as refusal:
        assert "x.pt cannot be read as a checkpoint" in str(refusal)


def test_a_converted_checkpoint_has_every_tensor_even_if_tensors_share_bytes(tmp_path):
    # safetensors refuses shared bytes, and tied weights are common.
    base = torch.arange(12.0).reshape(3, 4)
    tensors = {
        "net.base": base,
        "net.turned": base.t(),
        "net.same": base,
        "net.count": torch.tensor([3]),
        "net.half": torch.tensor(0.5, dtype=torch.bfloat16),
    }
    torch.save({"state_dict": tensors, "epoch": 3}, tmp_path / "x.ckpt")
    line = convert_file(tmp_path / "x.ckpt", tmp_path / "new" / "x.safetensors")
    data = (tmp_path / "new" / "x.safetensors").read_bytes()
    assert (line.name, line.size, line.digest) == ("x.safetensors", len(data), digest_of(data))
    source = f"x.ckpt ({digest_of((tmp_path / 'x.ckpt').read_bytes())}) with the same tensor names"
    assert (line.licence, line.slot, line.source) == ("?", "?", source)
    loaded = load_tensors(tmp_path / "new" / "x.safetensors")
    assert loaded.keys() == tensors.keys()
    assert all(torch.equal(loaded[name], tensor) for name, tensor in tensors.items())
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["x.safetensors"]


def test_the_line_of_a_converted_file_has_the_manifests_licence_and_slot(tmp_path, monkeypatch):
    torch.save({"a": torch.zeros(1)}, tmp_path / "x.pt")
    digest = digest_of((tmp_path / "x.pt").read_bytes())
    by_digest = WeightFile("known.pt", -1, digest, "MIT", "slot", "web")
    by_name = WeightFile("x.pt", -1, UNVERIFIED, "BSD", "other", "web")
    # The name alone is no proof if the manifest has another digest.
    another = WeightFile("x.pt", -1, digest_of(b""), "BSD", "other", "web")
    told = []
    for files in ([by_name, by_digest], [by_name], [another]):
        monkeypatch.setattr(checkpoint, "manifest", lambda files=files: files)
        line = convert_file(tmp_path / "x.pt", tmp_path / "x.safetensors")
        told.append((line.licence, line.slot, line.source.split()[0]))
    assert told == [("MIT", "slot", "known.pt"), ("BSD", "other", "x.pt"), ("?", "?", "x.pt")]


@pytest.mark.filterwarnings("ignore:ComplexHalf")
def test_a_file_that_cannot_be_converted_is_refused_with_the_reason(tmp_path):
    torch.save({"a": torch.zeros(1)}, tmp_path / "x.pt")
    torch.save({"a": torch.zeros(1).to(torch.complex32)}, tmp_path / "odd.pt")
    for file, result, message in (
        ("x.pt", "x.bin", r"x\.bin: the name must end in \.safetensors"),
        ("gone.pt", "x.safetensors", r"gone\.pt cannot be read"),
        (
            "odd.pt",
            "x.safetensors",
            r"odd\.pt: safetensors has no type for tensors of torch\.complex32",
        ),
        ("x.pt", "x.pt/x.safetensors", r"x\.safetensors cannot be written"),
    ):
        with pytest.raises(UserError, match=message):
            convert_file(tmp_path / file, tmp_path / result)
