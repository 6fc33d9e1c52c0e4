"""Checkpoints as safetensors."""

import pytest
import torch
from weight_files import digest_of

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights import checkpoint as module
from mkpc_kaggle.weights import load_tensors
from mkpc_kaggle.weights.checkpoint import convert
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile


def test_every_tensor_comes_through_whatever_it_shares(tmp_path):
    base = torch.arange(12.0).reshape(3, 4)
    tensors = {"net.base": base, "net.turned": base.t(), "net.same": base, "net.count": torch.tensor([3])}
    tensors |= {"net.half": torch.tensor(0.5, dtype=torch.bfloat16)}
    torch.save({"state_dict": tensors, "epoch": 3}, tmp_path / "x.ckpt")
    line = convert(tmp_path / "x.ckpt", tmp_path / "new" / "x.safetensors")
    data = (tmp_path / "new" / "x.safetensors").read_bytes()
    assert (line.name, line.size, line.digest) == ("x.safetensors", len(data), digest_of(data))
    source = f"x.ckpt ({digest_of((tmp_path / 'x.ckpt').read_bytes())}) with the same tensor names"
    assert (line.licence, line.slot, line.source) == ("?", "?", source)
    loaded = load_tensors(tmp_path / "new" / "x.safetensors")
    assert loaded.keys() == tensors.keys()
    assert all(torch.equal(loaded[name], tensor) for name, tensor in tensors.items())
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["x.safetensors"]


def test_the_line_takes_over_what_the_manifest_knows(tmp_path, monkeypatch):
    torch.save({"a": torch.zeros(1)}, tmp_path / "x.pt")
    digest = digest_of((tmp_path / "x.pt").read_bytes())
    by_digest = WeightFile("known.pt", -1, digest, "MIT", "slot", "web")
    by_name = WeightFile("x.pt", -1, UNVERIFIED, "BSD", "other", "web")
    another = WeightFile("x.pt", -1, digest_of(b""), "BSD", "other", "web")
    told = []
    for files in ([by_name, by_digest], [by_name], [another]):
        monkeypatch.setattr(module, "manifest", lambda files=files: files)
        line = convert(tmp_path / "x.pt", tmp_path / "x.safetensors")
        told.append((line.licence, line.slot, line.source.split()[0]))
    assert told == [("MIT", "slot", "known.pt"), ("BSD", "other", "x.pt"), ("?", "?", "x.pt")]


@pytest.mark.filterwarnings("ignore:ComplexHalf")
def test_what_cannot_be_converted_is_stated(tmp_path):
    torch.save({"a": torch.zeros(1)}, tmp_path / "x.pt")
    torch.save({"a": torch.zeros(1).to(torch.complex32)}, tmp_path / "odd.pt")
    for file, result, message in (
        ("x.pt", "x.bin", r"x\.bin: the name must end in \.safetensors"),
        ("gone.pt", "x.safetensors", r"gone\.pt cannot be read"),
        ("odd.pt", "x.safetensors", r"odd\.pt: safetensors has no type for tensors of torch\.complex32"),
        ("x.pt", "x.pt/x.safetensors", r"x\.safetensors cannot be written"),
    ):
        with pytest.raises(UserError, match=message):
            convert(tmp_path / file, tmp_path / result)
