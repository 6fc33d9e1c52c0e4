"""Weights: the manifest, where files are searched, that they are what they should be, that none runs code."""

import hashlib
import os
import pickle
import warnings
from dataclasses import replace

import pytest
import torch
from safetensors.torch import save_file
from shared import WEIGHTS, needs_weights

from mkpc_kaggle import weights
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Training
from mkpc_kaggle.matchers.registry import registry
from mkpc_kaggle.weights import UNVERIFIED, WeightFile, WeightStore, load_tensors, manifest, parse_manifest

DATA = b"these are the weights"
OTHER = b"those were the weights"[:21]


@pytest.fixture(autouse=True)
def nowhere_else(monkeypatch, tmp_path):
    """Only the directories that a test names are searched."""
    monkeypatch.delenv("MKPC_WEIGHTS", raising=False)
    monkeypatch.setattr(weights, "KAGGLE_INPUT", tmp_path / "no kaggle")


def digest_of(data):
    return "sha256:" + hashlib.sha256(data).hexdigest()


def line(name="a.bin", data=DATA, digest=None, slot="slot"):
    return WeightFile(name, len(data), digest or digest_of(data), "MIT", slot, "somewhere")


def put(directory, name="a.bin", data=DATA):
    directory.mkdir(parents=True, exist_ok=True)
    (directory / name).write_bytes(data)
    return directory


# the manifest


def test_the_manifest_has_every_slot_of_every_matcher_with_its_licence():
    licences = {
        slot: {file.licence for file in manifest() if file.slot == slot}
        for file in manifest()
        for slot in [file.slot]
    }
    for entry in registry().values():
        options = entry.spec.options()
        for slot in entry.spec.slots_for(options):
            assert licences[slot] & set(entry.spec.licences), slot
        if hasattr(options, "training"):
            indoor = entry.spec.slots_for(replace(options, training=Training.INDOOR))
            assert indoor != entry.spec.slots_for(options)
            assert all(licences[slot] for slot in indoor)


def test_every_digest_of_the_manifest_is_whole_and_every_name_is_there_once():
    names = [file.name for file in manifest()]
    assert len(set(names)) == len(names)
    for file in manifest():
        assert file.digest == UNVERIFIED or len(bytes.fromhex(file.digest.removeprefix("sha256:"))) == 32


@needs_weights
def test_the_shared_checkpoints_are_those_of_the_manifest():
    store = WeightStore([WEIGHTS])
    for slot in ("aliked-n16", "xfeat", "xfeat-lighterglue"):
        found = store.find(slot)
        assert found is not None
        assert found.digest == found.file.digest
        assert all(tensor.isfinite().all() for tensor in store.load(slot).values())


def test_a_manifest_reads_as_written():
    text = "# head\n\na.pt 12 sha256:00ff MIT one  https://x/a.pt (a copy)  # why\n  b.pt ? unverified BSD two y\n"
    assert parse_manifest(text) == (
        WeightFile("a.pt", 12, "sha256:00ff", "MIT", "one", "https://x/a.pt (a copy)"),
        WeightFile("b.pt", -1, UNVERIFIED, "BSD", "two", "y"),
    )


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ("a.pt 12 unverified MIT one", "expected 6 columns, found 5"),
        ("a.pt 12 unverified MIT one # x", "expected 6 columns, found 5"),
        ("../a.pt 12 unverified MIT one x", "'../a.pt' is not a plain file name"),
        ("d/a.pt 12 unverified MIT one x", "'d/a.pt' is not a plain file name"),
        ("a.pt 12kB unverified MIT one x", "bytes must be a number or '\\?', not '12kB'"),
        ("a.pt -1 unverified MIT one x", "bytes must be a number or '\\?', not '-1'"),
        ("a.pt 12 md5:00 MIT one x", "digest must be .* not 'md5:00'"),
        ("a.pt 12 ? MIT one x", "digest must be"),
    ],
)
def test_a_manifest_line_that_cannot_be_read_is_named_by_its_number(wrong, says):
    with pytest.raises(UserError, match=f"list.txt, line 3: {says}"):
        parse_manifest(f"# head\nok.pt 12 unverified MIT one x\n{wrong}\n", "list.txt")


# searching


def test_a_file_is_found_in_the_directory_and_below_it(tmp_path):
    assert WeightStore([put(tmp_path / "a")], [line()]).find("slot").path == tmp_path / "a" / "a.bin"
    put(tmp_path / "b" / "deep" / "deeper")
    found = WeightStore([tmp_path / "b"], [line()]).find("slot")
    assert (found.path, found.digest) == (tmp_path / "b" / "deep" / "deeper" / "a.bin", digest_of(DATA))


def test_a_directory_that_bears_the_name_of_the_file_is_looked_into(tmp_path):
    """Kaggle makes such directories of data sets of one file."""
    put(tmp_path / "a.bin")
    assert WeightStore([tmp_path], [line()]).find("slot").path == tmp_path / "a.bin" / "a.bin"


def test_directories_are_searched_in_order_then_the_environment_then_kaggle(tmp_path, monkeypatch):
    homes = [put(tmp_path / name) for name in ("one", "two", "three", "four", "kaggle")]
    monkeypatch.setenv("MKPC_WEIGHTS", os.pathsep.join(map(str, [tmp_path / "gone", *homes[2:4]])))
    monkeypatch.setattr(weights, "KAGGLE_INPUT", homes[4])
    for home in homes:
        assert WeightStore(homes[:2], [line()]).find("slot").path == home / "a.bin"
        (home / "a.bin").unlink()
    assert WeightStore(homes[:2], [line()]).find("slot") is None


def test_the_first_alternative_that_is_there_is_taken(tmp_path):
    files = [line("a.bin"), line("b.bin", OTHER), line("c.bin", slot="other")]
    put(tmp_path, "b.bin", OTHER)
    assert WeightStore([tmp_path], files).find("slot").file.name == "b.bin"
    put(tmp_path, "a.bin")
    assert WeightStore([tmp_path], files).find("slot").file.name == "a.bin"


def test_a_directory_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"--weights .*gone: no such directory"):
        WeightStore([tmp_path / "gone"])


def test_missing_weights_are_named_with_all_alternatives_and_where_they_were_searched(tmp_path):
    store = WeightStore([tmp_path], [line("a.bin"), line("b.bin")])
    assert store.find("slot") is None
    with pytest.raises(UserError, match=rf"'slot': a\.bin or b\.bin not found \(searched {tmp_path}\)"):
        store.load("slot")
    with pytest.raises(UserError, match=r"--weights"):
        WeightStore([], [line()]).load("slot")


def test_an_unknown_slot_is_a_mistake_in_the_code():
    with pytest.raises(KeyError, match="'slto'"):
        WeightStore([], [line()]).find("slto")


# verifying


def test_a_truncated_file_is_refused_with_both_sizes(tmp_path):
    put(tmp_path, data=DATA[:-1])
    with pytest.raises(UserError, match=r"a\.bin: 20 bytes, the manifest says 21"):
        WeightStore([tmp_path], [line()]).find("slot")


def test_other_bytes_of_the_same_size_are_refused_with_both_digests(tmp_path):
    put(tmp_path, data=OTHER)
    with pytest.raises(UserError, match=f"a.bin: .*{digest_of(OTHER)}.*{digest_of(DATA)}"):
        WeightStore([tmp_path], [line()]).load("slot")


def test_an_unverified_file_warns_once_in_a_store_and_names_its_digest(tmp_path):
    store = WeightStore([put(tmp_path)], [line(digest=UNVERIFIED)])
    with pytest.warns(UserWarning, match=f"a.bin is not verified.*{digest_of(DATA)}"):
        assert store.find("slot").digest == digest_of(DATA)
    with warnings.catch_warnings(record=True) as more:
        warnings.simplefilter("always")
        store.find("slot")
    assert more == []


def test_a_file_of_unknown_size_is_still_held_against_its_digest(tmp_path):
    file = WeightFile("a.bin", -1, digest_of(DATA), "MIT", "slot", "somewhere")
    assert WeightStore([put(tmp_path / "good")], [file]).find("slot") is not None
    with pytest.raises(UserError, match="digest"):
        WeightStore([put(tmp_path / "bad", data=OTHER)], [file]).find("slot")


# loading


TENSORS = {"a.weight": torch.arange(6.0).reshape(2, 3), "a.count": torch.tensor(7), "b": torch.zeros(0)}


def test_both_file_formats_give_the_same_tensors(tmp_path):
    save_file(TENSORS, tmp_path / "x.safetensors")
    torch.save(TENSORS, tmp_path / "x.pt")
    for suffix in ("safetensors", "pt"):
        loaded = load_tensors(tmp_path / f"x.{suffix}")
        assert loaded.keys() == TENSORS.keys()
        for name, tensor in TENSORS.items():
            assert loaded[name].dtype == tensor.dtype
            assert torch.equal(loaded[name], tensor)


class Bomb:
    """Unpickled, it makes a directory."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("save", [torch.save, lambda value, path: path.write_bytes(pickle.dumps(value))])
def test_a_pickle_that_would_run_code_is_refused_and_runs_nothing(tmp_path, save):
    save({"a": Bomb(tmp_path / "boom")}, tmp_path / "x.pt")
    with pytest.raises(UserError, match=r"x\.pt cannot be read as a checkpoint"):
        load_tensors(tmp_path / "x.pt")
    assert not (tmp_path / "boom").exists()


@pytest.mark.parametrize("name", ["x.pt", "x.safetensors"])
@pytest.mark.parametrize("data", [b"", b"no checkpoint", b"\0" * 100])
def test_a_file_that_is_no_checkpoint_is_refused_by_name(tmp_path, name, data):
    put(tmp_path, name, data)
    with pytest.raises(UserError, match=rf"{name} cannot be read as a checkpoint"):
        load_tensors(tmp_path / name)


def test_a_checkpoint_that_is_one_tensor_is_refused(tmp_path):
    torch.save(torch.zeros(3), tmp_path / "x.pt")
    with pytest.raises(UserError, match=r"x\.pt cannot be read as a checkpoint"):
        load_tensors(tmp_path / "x.pt")
