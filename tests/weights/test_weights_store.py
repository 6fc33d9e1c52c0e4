"""The search for weight files, their comparison with the manifest, and the manifest itself."""

import os
import pickle
import re
from pathlib import Path

import pytest
from weight_files import DATA, OTHER, digest_of, line, put

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.registry import MATCHERS, spec_of
from mkpc_kaggle.weights import WeightStore, store
from mkpc_kaggle.weights.manifest import WeightFile, manifest, read_manifest

pytestmark = pytest.mark.usefixtures("nowhere_else")


def found_by(weights: WeightStore) -> Path:
    return weights.file_of("slot").path


def test_a_file_is_found_in_the_directory_and_below_it(tmp_path):
    assert found_by(WeightStore([put(tmp_path / "a")], [line()])) == tmp_path / "a" / "a.pt"
    put(tmp_path / "b" / "deep" / "deeper")
    found = WeightStore([tmp_path / "b"], [line()]).file_of("slot")
    assert found.path == tmp_path / "b" / "deep" / "deeper" / "a.pt"
    assert found.sha256 == digest_of(DATA)
    with pytest.raises(UserError, match=r"--weights .*gone: no such directory"):
        WeightStore([tmp_path / "gone"])


def test_directories_are_searched_in_order_then_the_environment_then_kaggle(
    tmp_path, monkeypatch
):
    homes = [put(tmp_path / name) for name in ("one", "two", "three", "four", "kaggle")]
    # A directory of the environment may be missing, such as a drive that is not mounted.
    listed = [tmp_path / "gone", *homes[2:4]]
    monkeypatch.setenv("MKPC_WEIGHTS", os.pathsep.join(map(str, listed)))
    monkeypatch.setattr(store, "KAGGLE_INPUT", homes[4])
    for home in homes:
        assert found_by(WeightStore(homes[:2], [line()])) == home / "a.pt"
        (home / "a.pt").unlink()
    assert WeightStore(homes[:2], [line()]).file_of("slot") is None


def test_the_first_existing_alternative_is_taken_and_missing_ones_are_all_named(tmp_path):
    files = [line("a.pt"), line("b.pt", OTHER), line("c.pt", slot="other")]
    says = (
        r"no weights for slot: a\.pt or b\.pt not found; `mkpc weights fetch slot --out DIR`"
    )
    with pytest.raises(UserError, match=says):
        WeightStore([tmp_path], files).load("slot")
    put(tmp_path, "b.pt", OTHER)
    assert found_by(WeightStore([tmp_path], files)).name == "b.pt"
    put(tmp_path, "a.pt")
    assert found_by(WeightStore([tmp_path], files)).name == "a.pt"


def test_a_store_that_is_sent_to_a_worker_digests_no_file_again(tmp_path, monkeypatch):
    weights = WeightStore([put(tmp_path)], [line()])
    assert weights.file_of("slot") is not None
    sent = pickle.dumps(weights)
    monkeypatch.setattr(store, "digest_of", None)
    assert pickle.loads(sent).file_of("slot") == weights.file_of("slot")


def test_links_to_directories_are_followed_once(tmp_path):
    put(tmp_path / "outside", "b.pth")
    inside = put(tmp_path / "inside" / "deep", "a.pth")
    (inside / "loop").symlink_to(tmp_path / "inside")
    (inside / "out").symlink_to(tmp_path / "outside")
    (inside / "file.pth").symlink_to(tmp_path / "outside" / "b.pth")
    files = [line("a.pth"), line("b.pth"), line("file.pth")]
    # A link to a folder above would never end.
    found = WeightStore([tmp_path / "inside"], files).search(files)
    assert [file.path.name for file in found] == ["a.pth", "b.pth", "file.pth"]


def test_a_manifest_beside_weights_adds_files_and_overrides_none(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "manifest", lambda: (line("a.pt"),))
    put(tmp_path / "deep", "b.pt", OTHER)
    text = f'["a.pt"]\nslot = "slot"\nlicence = "MIT"\nsha256 = "{digest_of(OTHER)}"\n'
    text += text.replace("a.pt", "b.pt")
    (tmp_path / "deep" / "weights_manifest.txt").write_text(text)
    weights = WeightStore([tmp_path])
    # A dataset of somebody else cannot make its own "a.pt" a good one.
    assert weights.files == (
        line("a.pt"),
        WeightFile("slot", "MIT", sha256=digest_of(OTHER), name="b.pt"),
    )
    assert found_by(weights).name == "b.pt"


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (OTHER[:21], f"{digest_of(OTHER[:21])}.*{digest_of(DATA)}"),
        (DATA[:-1], "20 bytes.*cut off"),
    ],
)
def test_a_file_with_other_bytes_is_passed_over_by_name_and_the_search_continues(
    tmp_path, data, says
):
    put(tmp_path / "one", data=data)
    path = put(tmp_path / "two") / "a.pt"
    weights = WeightStore([tmp_path / "one", tmp_path / "two"], [line()])
    with pytest.warns(UserWarning, match=f"passed over: .*one/a.pt: .*{says}"):
        assert found_by(weights) == path
    # A second warning would be an error here.
    assert found_by(weights) == path


@pytest.mark.parametrize("kind", ["pipe", "link"])
def test_a_pipe_or_a_broken_link_is_passed_over(tmp_path, kind):
    path = tmp_path / "a.pt"
    os.mkfifo(path) if kind == "pipe" else path.symlink_to(tmp_path / "nothing")
    weights = WeightStore([tmp_path], [line(size=0)])
    says = r"passed over: .*a\.pt: cannot be read: (No such|not a regular) file"
    with pytest.warns(UserWarning, match=says):
        assert weights.file_of("slot") is None


@pytest.mark.parametrize(
    "text", [None, b"no manifest", b"#" * (1 << 25)], ids=["pipe", "garbage", "too large"]
)
def test_a_manifest_that_cannot_be_read_is_passed_over(tmp_path, text):
    path = put(tmp_path) / "weights_manifest.txt"
    os.mkfifo(path) if text is None else path.write_bytes(text)
    with pytest.warns(UserWarning, match=r"passed over: .*weights_manifest\.txt"):
        assert WeightStore([tmp_path]).files


def test_the_manifest_has_every_slot_of_every_matcher():
    slots = {file.slot for file in manifest()}
    for name in MATCHERS:
        spec = spec_of(name, "test")
        assert slots.issuperset(spec.slots_for(spec.options()))
    for file in manifest():
        assert re.fullmatch("([0-9a-f]{64})?", file.sha256)
        assert file.url or file.source
        # pip gets no option and no path from a manifest.
        assert re.fullmatch(r"(\w[\w.-]*==\w[\w.+!-]*/\S+)?", file.wheel)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ('slot = "x"', "table 'a.pt': missing keys 'licence'"),
        ('slot = "x"\nlicence = "MIT"\nbytes = 3', "unknown key 'bytes'"),
        ('slot = "x"\nlicence = "MIT"\nsize = "3"', "expected int, got '3'"),
        ("slot = ", "Invalid value"),
    ],
)
def test_a_table_that_cannot_be_read_is_named(tmp_path, table, says):
    path = tmp_path / "list.txt"
    path.write_text(f'["a.pt"]\n{table}\n')
    with pytest.raises(UserError, match=f"list.txt.*{says}"):
        read_manifest(path)
