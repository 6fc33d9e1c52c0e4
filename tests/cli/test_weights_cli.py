"""``mkpc weights``: its output and its exit status."""

import io
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from checkpoints import FILES as FILES_OF_PAPER
from checkpoints import write_checkpoints
from shared import run_command
from web import Site, serve
from weight_files import DATA, OTHER, digest_of, line, put

from mkpc_kaggle.weights import UNVERIFIED, store

# Two files that fit one slot, one without a digest, and one that is missing.
FILES = (
    line("sift.pt", slot="sift"),
    line("a.pt", OTHER, slot="aliked-n16"),
    line("b.pt", b"more", slot="aliked-n16", size=-1, digest=UNVERIFIED),
    line("lost.pt", b"lost", slot="superpoint"),
)


@pytest.fixture(autouse=True)
def own_manifest(monkeypatch: pytest.MonkeyPatch, nowhere_else: None) -> None:
    monkeypatch.setattr(store, "manifest", lambda: FILES)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    return put(put(tmp_path / "weights", "sift.pt"), "renamed.pt", OTHER)


def test_list_has_the_path_of_each_file_and_the_matchers_that_missing_ones_would_enable(
    weights, capsys
):
    assert run_command("weights", "list", "--weights", weights) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["sift", "MIT", "-", str(weights / "sift.pt")]
    users = ["aliked,", "aliked_lightglue"]
    assert lines[2].split() == ["aliked-n16", "MIT", *users, str(weights / "renamed.pt")]
    users = ["superglue,", "superpoint_lightglue"]
    assert lines[3].split() == ["superpoint", "MIT", *users, "missing:", "lost.pt"]
    assert len(lines) == 4


def checkpoint(**tensors: torch.Tensor) -> bytes:
    stream = io.BytesIO()
    torch.save(tensors, stream)
    return stream.getvalue()


@pytest.fixture
def checkpoints(monkeypatch: pytest.MonkeyPatch) -> tuple[bytes, bytes]:
    """Two checkpoints of a slot that no matcher uses, and lines of a manifest for them."""
    one = checkpoint(a=torch.zeros(3))
    other = checkpoint(a=torch.ones(3))
    unknown = line("new.pt", size=-1, digest=UNVERIFIED)
    lines = line("one.pt", one), line("other.pt", other), unknown
    monkeypatch.setattr(store, "manifest", lambda: lines)
    return one, other


def test_verify_lists_refused_files_and_fails(tmp_path, checkpoints, capsys):
    one, other = checkpoints
    weights = put(tmp_path, "one.pt", one)
    put(weights, "renamed.pt", other)
    put(weights, "new.pt", checkpoint(b=torch.zeros(1)))
    assert run_command("weights", "verify", "--weights", weights) == 0
    assert "3 files, 0 refused" in capsys.readouterr().out
    put(weights, "other.pt", one)  # two files exchanged, as happens when they are renamed
    assert run_command("weights", "verify", "--weights", weights) == 1
    assert "it has the bytes of one.pt" in capsys.readouterr().out


def verified(capsys: pytest.CaptureFixture[str], weights: Path, status: int) -> dict[str, str]:
    """Verify the weights; return the table's lines by the names of files."""
    assert run_command("weights", "verify", "--weights", weights) == status
    return {row.split()[0]: row for row in capsys.readouterr().out.splitlines() if row.split()}


def test_verify_says_which_matchers_networks_a_file_fits(tmp_path, monkeypatch, capsys):
    lines = write_checkpoints(tmp_path, FILES_OF_PAPER[:3])
    monkeypatch.setattr(store, "manifest", lambda: lines)
    rows = verified(capsys, tmp_path, 0)
    fitting = [rows[file.name].split("fits ")[-1] for file in lines]
    assert fitting == ["superglue", "superglue", "loftr"]


def test_verify_refuses_a_file_with_the_manifests_digest_that_no_network_takes(
    tmp_path, monkeypatch, capsys
):
    # A digest alone said "good" of files that ended the run when a network loaded them.
    wrong = checkpoint(a=torch.zeros(3))
    slots = ("dkm-outdoor", "xfeat")
    names = [line(f"{slot}.pt", wrong, slot=slot) for slot in slots]
    files = (*names, line("superpoint.pt", slot="superpoint"))
    monkeypatch.setattr(store, "manifest", lambda: files)
    for file in names:
        put(tmp_path, file.name, wrong)
    rows = verified(capsys, put(tmp_path, "superpoint.pt"), 1)
    assert "refused" in rows["dkm-outdoor.pt"]
    says = "the weights for 'dkm-outdoor' do not fit the network: the network also has decoder."
    assert says in rows["dkm-outdoor.pt"]
    assert "the file also has a" in rows["dkm-outdoor.pt"]
    assert "cannot be read as a checkpoint" in rows["superpoint.pt"]
    # A matcher is only built from all its files.
    says = "not tried in a network: xfeat_lighterglue also needs xfeat-lighterglue"
    assert rows["xfeat.pt"].endswith(says)
    assert rows["3"].startswith("3 files, 2 refused")


def test_a_file_is_not_refused_for_another_one_of_the_same_matcher(tmp_path, monkeypatch, capsys):
    lines = write_checkpoints(tmp_path, FILES_OF_PAPER[:1])
    wrong = checkpoint(a=torch.zeros(3))
    put(tmp_path, "wrong.pt", wrong)
    files = (*lines, line("wrong.pt", wrong, slot="superglue-outdoor"))
    monkeypatch.setattr(store, "manifest", lambda: files)
    rows = verified(capsys, tmp_path, 1)
    assert " good " in rows["superpoint_v1.pth"]
    says = "not tried in a network: the weights for 'superglue-outdoor' do not"
    assert says in rows["superpoint_v1.pth"]
    assert " refused " in rows["wrong.pt"]


def test_fetch_takes_files_slots_and_recipes(tmp_path, monkeypatch, capsys):
    recipe = tmp_path / "own.toml"
    recipe.write_text('units = [{stage = 1, matcher = "aliked", long_side = 320}]')
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with serve(Site(DATA)) as site:
        # The second has no address: its authors want a form to be filled in.
        sift, by_hand, unverified = FILES[:3]
        web = [
            replace(sift, source=site.url),
            replace(by_hand, source="by hand"),
            replace(unverified, source=site.url),
        ]
        monkeypatch.setattr(store, "manifest", lambda: web)
        fetch = ["weights", "fetch", "--out", tmp_path / "out"]
        assert run_command(*fetch, "sift.pt", "sift", recipe) == 0
        out = capsys.readouterr().out
        # A file, its slot and a recipe: "sift.pt" is named twice and fetched once.
        assert len(site.asked) == 2
        assert run_command(*fetch, "a.pt", "sift") == 1
        assert len(site.asked) == 2
    assert f"sift.pt: licence MIT, from {site.url}\nsift.pt: fetched\n" in out
    assert "b.pt: fetched: not verified" in out
    again = capsys.readouterr().out
    assert f"a.pt: by hand: get it from by hand and save it as {tmp_path / 'out' / 'a.pt'}" in again
    assert "sift.pt: already there\n" in again
    there = ["b.pt", "sift.pt", "weights_manifest.txt"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == there


def test_the_first_download_of_a_file_without_a_digest_is_accepted_from_then_on(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    out = tmp_path / "out"
    fetch = ["weights", "fetch", "b.pt", "--out", out]
    with serve(Site(DATA)) as site:
        file = replace(FILES[2], licence="own", source=site.url)
        monkeypatch.setattr(store, "manifest", lambda: (file,))
        assert run_command(*fetch) == 0
        (pinned,) = store.WeightStore([out]).files
        assert (pinned.size, pinned.digest, pinned.licence) == (len(DATA), digest_of(DATA), "own")
        (out / "b.pt").unlink()
        assert run_command(*fetch) == 0
        (out / "b.pt").unlink()
        # The authors replace the file, or somebody else does.
        site.data = OTHER
        capsys.readouterr()
        assert run_command(*fetch) == 1
    told = capsys.readouterr().out
    assert digest_of(OTHER) in told
    assert digest_of(DATA) in told
    assert not (out / "b.pt").exists()
    (out / "b.pt").write_bytes(OTHER)
    with pytest.warns(UserWarning, match="damaged, or another file"):
        assert store.WeightStore([out]).file_of("aliked-n16") is None
