"""``mkpc weights``: its output and its exit status."""

from pathlib import Path

import pytest
import torch
from shared import run_command
from web import Site, serve
from weight_files import DATA, OTHER, line, put

from mkpc_kaggle.cli import weights as command
from mkpc_kaggle.weights import store

# Two files that fit one slot, one without a digest, and one that is missing.
FILES = (
    line("sift.pt", slot="sift"),
    line("a.pt", OTHER, slot="aliked-n16"),
    line("b.pt", slot="aliked-n16", size=0, sha256=""),
    line("lost.pt", b"lost", slot="superpoint"),
)


@pytest.fixture(autouse=True)
def own_manifest(monkeypatch: pytest.MonkeyPatch, nowhere_else: None) -> None:
    for module in (store, command):
        monkeypatch.setattr(module, "manifest", lambda: FILES)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    return put(put(tmp_path / "weights", "sift.pt"), "b.pt", b"any")


def test_list_has_the_path_of_each_file_and_the_names_of_missing_ones(weights, capsys):
    assert run_command("weights", "list", "--weights", weights) == 0
    rows = [row.split() for row in capsys.readouterr().out.splitlines()]
    assert rows[1:] == [
        ["sift", "MIT", str(weights / "sift.pt")],
        ["aliked-n16", "MIT", str(weights / "b.pt")],
        ["superpoint", "MIT", "missing:", "lost.pt"],
    ]


def test_verify_lists_refused_files_and_missing_ones_of_another_manifest_and_fails(
    weights, capsys
):
    verify = ("weights", "verify", "--weights", weights)
    assert run_command(*verify) == 0
    told = capsys.readouterr().out
    assert "2 files, 0 refused, 0 missing" in told
    rows = {row.split()[0]: row.split()[1] for row in told.splitlines()[1:]}
    assert (rows["sift.pt"], rows["b.pt"]) == ("good", "unverified")
    put(weights, "a.pt", DATA)
    table = '["gone.safetensors"]\nslot = "x"\nlicence = "MIT"\n'
    (weights / "weights_manifest.txt").write_text(table)
    assert run_command(*verify) == 1
    told = capsys.readouterr().out
    assert "4 files, 1 refused, 1 missing" in told
    assert (
        f"{len(DATA)} bytes, the manifest says {len(OTHER)}: cut off, or another file" in told
    )
    assert "gone.safetensors  missing" in told


def test_fetch_takes_files_slots_and_recipes(tmp_path, monkeypatch, capsys):
    recipe = tmp_path / "own.toml"
    recipe.write_text('units = [{stage = 1, matcher = "aliked", long_side = 320}]')
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    out = tmp_path / "out"
    torch.save({}, tmp_path / "b.pt")  # without a digest, it must be a checkpoint
    data = (tmp_path / "b.pt").read_bytes()
    with serve(Site(data)) as site:
        # The second has no address: its authors want a form to be filled in.
        files = (
            line("sift.pt", data, slot="sift", url=site.url),
            line("a.pt", OTHER, slot="aliked-n16", source="a form"),
            line("b.pt", slot="aliked-n16", size=0, sha256="", url=site.url),
        )
        monkeypatch.setattr(command, "manifest", lambda: files)
        fetch = ["weights", "fetch", "--out", out]
        assert run_command(*fetch, "sift.pt", "sift", recipe) == 0
        told = capsys.readouterr().out
        # A file, its slot and a recipe: "sift.pt" is named twice and fetched once.
        assert len(site.asked) == 2
        assert run_command(*fetch, "a.pt", "sift") == 1
        assert len(site.asked) == 2
    assert "sift.pt: licence MIT, 0.0 MB\nsift.pt: fetched\n" in told
    assert "b.pt: fetched, not verified: no digest is known\n" in told
    again = capsys.readouterr()
    assert f"a.pt: not fetched: get it from a form and save it as {out / 'a.pt'}" in again.err
    assert "sift.pt: already there\n" in again.out
    # Of alternatives, a file that is there is taken before one with an address.
    put(out, "a.pt", OTHER)
    assert run_command(*fetch, "aliked-n16") == 0
    assert "a.pt: already there\n" in capsys.readouterr().out
    assert run_command(*fetch, "nothing") == 2
