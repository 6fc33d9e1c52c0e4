"""The search for weight files, their comparison with the manifest, and the manifest itself."""

import os
import pickle
import re
from pathlib import Path
from zipfile import ZipFile

import pytest
import torch
from weight_files import DATA, OTHER, digest_of, line, put

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.registry import MATCHERS, spec_of
from mkpc_kaggle.weights import UNVERIFIED, FileState, WeightStore, load_tensors, store
from mkpc_kaggle.weights import manifest as manifest_module
from mkpc_kaggle.weights.checkpoint import convert_file
from mkpc_kaggle.weights.manifest import WeightFile, manifest, parse_manifest
from mkpc_kaggle.weights.manifest import digest_of as file_digest

pytestmark = pytest.mark.usefixtures("nowhere_else")


def found_by(weights: WeightStore) -> Path:
    return weights.file_of("slot").path


def test_a_file_is_found_in_the_directory_and_below_it(tmp_path):
    assert found_by(WeightStore([put(tmp_path / "a")], [line()])) == tmp_path / "a" / "a.bin"
    put(tmp_path / "b" / "deep" / "deeper")
    found = WeightStore([tmp_path / "b"], [line()]).file_of("slot")
    assert found.path == tmp_path / "b" / "deep" / "deeper" / "a.bin"
    assert found.digest == digest_of(DATA)
    put(tmp_path / "c" / "a.bin")  # Kaggle makes these directories of data sets of one file
    assert found_by(WeightStore([tmp_path / "c"], [line()])) == tmp_path / "c" / "a.bin" / "a.bin"
    with pytest.raises(UserError, match=r"--weights .*gone: no such directory"):
        WeightStore([tmp_path / "gone"])


def test_directories_are_searched_in_order_then_the_environment_then_kaggle(tmp_path, monkeypatch):
    homes = [put(tmp_path / name) for name in ("one", "two", "three", "four", "kaggle")]
    # A directory of the environment may be missing, such as a drive that is not mounted.
    listed = [tmp_path / "gone", *homes[2:4]]
    monkeypatch.setenv("MKPC_WEIGHTS", os.pathsep.join(map(str, listed)))
    monkeypatch.setattr(store, "KAGGLE_INPUT", homes[4])
    for home in homes:
        assert found_by(WeightStore(homes[:2], [line()])) == home / "a.bin"
        (home / "a.bin").unlink()
    assert WeightStore(homes[:2], [line()]).file_of("slot") is None


def test_the_first_existing_alternative_is_taken_and_missing_ones_are_all_named(tmp_path):
    files = [line("a.bin"), line("b.bin", OTHER), line("c.bin", slot="other")]
    says = rf"slot: a\.bin or b\.bin not found \(searched {tmp_path}\)"
    with pytest.raises(UserError, match=says):
        WeightStore([tmp_path], files).load("slot")
    put(tmp_path, "renamed.bin", DATA)
    put(tmp_path, "b.bin", OTHER)
    assert found_by(WeightStore([tmp_path], files)).name == "b.bin", "a name goes before a digest"
    put(tmp_path, "a.bin")
    assert found_by(WeightStore([tmp_path], files)).name == "a.bin"


def test_a_renamed_file_is_found_by_its_size_and_digest(tmp_path, monkeypatch):
    read = []
    monkeypatch.setattr(store, "digest_of", lambda path: read.append(path) or file_digest(path))
    put(tmp_path / "data set" / "v1", "model")
    put(tmp_path, "same size.dat", OTHER)
    put(tmp_path, "long.pth", DATA + b"!")
    found = WeightStore([tmp_path], [line()]).file_of("slot")
    assert (found.path.name, found.state, found.note) == ("model", FileState.GOOD, "it is a.bin")
    # Another size cannot have the digest, so gigabytes stay unread.
    assert "long.pth" not in {path.name for path in read}


def test_a_store_that_is_sent_to_a_worker_digests_no_file_again(tmp_path, monkeypatch):
    weights = WeightStore([put(tmp_path)], [line()])
    assert weights.file_of("slot") is not None
    sent = pickle.dumps(weights)
    monkeypatch.setattr(store, "digest_of", None)
    assert pickle.loads(sent).file_of("slot") == weights.file_of("slot")


def test_processes_that_share_a_file_of_digests_read_a_weight_file_once(tmp_path, monkeypatch):
    # The notebook verifies 3 GB of weights, and its run then asks for the same digests.
    reads = []
    monkeypatch.setattr(manifest_module, "counted", lambda blocks, *_: reads.append(1) or blocks)
    monkeypatch.setenv("MKPC_DIGESTS", str(tmp_path / "new" / "digests.txt"))
    path = put(tmp_path) / "a.bin"
    for _ in range(2):
        manifest_module._file_digest.cache_clear()  # as in another process
        assert file_digest(path) == digest_of(DATA)
    assert len(reads) == 1
    put(tmp_path, data=OTHER)
    os.utime(path, (1, 1))  # the size is the same
    assert file_digest(path) == digest_of(OTHER)


def test_links_to_directories_are_followed_once(tmp_path):
    put(tmp_path / "outside", "b.pth")
    inside = put(tmp_path / "inside" / "deep", "a.pth")
    (inside / "loop").symlink_to(tmp_path / "inside")
    (inside / "out").symlink_to(tmp_path / "outside")
    (inside / "file.pth").symlink_to(tmp_path / "outside" / "b.pth")
    files = [line("a.pth"), line("b.pth"), line("file.pth")]
    # A link to a folder above would never end.
    found = WeightStore([tmp_path / "inside"], files).verify()
    assert [file.path.name for file in found] == ["a.pth", "file.pth", "b.pth"]


@pytest.mark.parametrize("outer", ["x.pth", "x"])
def test_an_unpacked_checkpoint_is_found_and_read(tmp_path, outer):
    tensors = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([1, 2])}
    torch.save({"state_dict": tensors, "epoch": 3}, tmp_path / "x.pth")
    file = line("x.pth", (tmp_path / "x.pth").read_bytes())
    # Kaggle unpacks the archive that a checkpoint is, with or without its suffix in the folder's name.
    with ZipFile(tmp_path / "x.pth") as archive:
        archive.extractall(tmp_path / "input" / "someones" / outer)
    os.utime(tmp_path / "input" / "someones" / outer / "x" / "data.pkl", (0, 0))
    weights = WeightStore([tmp_path / "input"], [file])
    found = weights.file_of("slot")
    # The digest of the file cannot be computed from its parts.
    assert found.state is FileState.UNVERIFIED
    assert found.path == tmp_path / "input" / "someones" / outer / "x"
    assert weights.load("slot").keys() == tensors.keys()
    assert found.digest in convert_file(found.path, tmp_path / "x.safetensors").source
    loaded = load_tensors(tmp_path / "x.safetensors")
    assert all(torch.equal(loaded[name], tensor) for name, tensor in tensors.items())
    record = found.path / "data" / "0"
    record.write_bytes(record.read_bytes()[:-4])
    with pytest.raises(UserError, match="cannot be read as a checkpoint"):
        load_tensors(found.path)


def test_a_manifest_beside_weights_adds_lines_and_overrides_none(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "manifest", lambda: (line("a.bin"),))
    put(tmp_path / "deep", "b.bin", OTHER)
    lines = (line("a.bin", OTHER), line("b.bin", OTHER))
    text = "".join(f"{file.line}\n" for file in lines)
    (tmp_path / "deep" / "weights_manifest.txt").write_text(text)
    weights = WeightStore([tmp_path])
    # A dataset of somebody else cannot make its own "a.bin" a good one.
    assert weights.files == (line("a.bin"), line("b.bin", OTHER))
    assert found_by(weights).name == "b.bin"


def test_other_bytes_of_the_same_size_are_refused_with_both_digests(tmp_path):
    put(tmp_path, data=OTHER)
    with (
        pytest.warns(UserWarning, match=f"a.bin: .*{digest_of(OTHER)}.*{digest_of(DATA)}"),
        pytest.raises(UserError, match=r"no weights for slot: a\.bin not found.*fetch slot"),
    ):
        WeightStore([tmp_path], [line()]).load("slot")


def test_the_search_continues_after_a_bad_file(tmp_path):
    put(tmp_path / "one", "a.bin", DATA[:-1])
    path = put(tmp_path / "two", "renamed.bin", DATA) / "renamed.bin"
    folders = [tmp_path / "one", tmp_path / "two"]
    weights = WeightStore(folders, [line("a.bin"), line("b.bin", OTHER)])
    says = r"passed over: .*one/a\.bin: 20 bytes, the manifest says 21"
    with pytest.warns(UserWarning, match=says):
        assert found_by(weights) == path
    # A second warning would be an error here.
    assert found_by(weights) == path


@pytest.mark.parametrize("kind", ["pipe", "link"])
def test_a_pipe_or_a_broken_link_is_passed_over(tmp_path, kind):
    path = tmp_path / "a.bin"
    os.mkfifo(path) if kind == "pipe" else path.symlink_to(tmp_path / "nothing")
    weights = WeightStore([tmp_path], [line()])
    says = r"passed over: .*a\.bin: cannot be read: (No such|not a regular) file"
    with pytest.warns(UserWarning, match=says):
        assert weights.file_of("slot") is None
    assert [file.state for file in weights.verify()] == [FileState.REFUSED]


@pytest.mark.parametrize(
    "text", [None, b"no manifest", b"#" * (1 << 25)], ids=["pipe", "garbage", "too large"]
)
def test_a_manifest_that_cannot_be_read_is_passed_over(tmp_path, text):
    path = put(tmp_path) / "weights_manifest.txt"
    os.mkfifo(path) if text is None else path.write_bytes(text)
    with pytest.warns(UserWarning, match=r"passed over: .*weights_manifest\.txt"):
        assert WeightStore([tmp_path]).files


SHA256 = "sha256:" + "0f" * 32


def test_the_manifest_has_every_slot_of_every_matcher():
    slots = {file.slot for file in manifest()}
    specs = [spec_of(name, "test") for name in MATCHERS]
    assert slots.issuperset(slot for spec in specs for slot in spec.slots_for(spec.options()))
    assert all(any(spec.uses(slot) for spec in specs) for slot in slots)


def test_a_manifest_reads_as_written():
    text = f"# head\n\na.pt 12 {SHA256} MIT one  https://x/a.pt (a copy)  # why\n"
    text += "  b.pt ? unverified BSD two y\n"
    files = parse_manifest(text)
    assert files == (
        WeightFile("a.pt", 12, SHA256, "MIT", "one", "https://x/a.pt (a copy)"),
        WeightFile("b.pt", -1, UNVERIFIED, "BSD", "two", "y"),
    )
    assert parse_manifest("\n".join(file.line for file in files)) == files


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ("a.pt 12 unverified MIT one", "expected 6 columns, found 5"),
        ("../a.pt 12 unverified MIT one x", "'../a.pt' is not a plain file name"),
        ("a.pt 12kB unverified MIT one x", "bytes must be a number or '?', not '12kB'"),
        (f"a.pt {'9' * 5000} unverified MIT one x", "bytes must be a number or '?', not '999"),
        ("a\x1b[2J.pt 12 unverified MIT one x", r"'a\x1b[2J.pt' is not a plain file name"),
        (f"a.pt 12 {SHA256[:-1]}g MIT one x", "digest must be"),
        (f"a.pt 12 git-blob:{'a1' * 20} MIT one x", "digest must be 'sha256:'"),
    ],
)
def test_a_line_that_cannot_be_read_is_named_by_its_number(wrong, says):
    with pytest.raises(UserError, match=f"list.txt, line 3: {re.escape(says)}"):
        parse_manifest(f"# head\nok.pt 12 unverified MIT one x\n{wrong}\n", "list.txt")
