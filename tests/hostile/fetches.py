"""Servers that lie or wander: ``weights fetch`` from a server of the test's own."""

import contextlib
import hashlib
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path

from attack import Case, nothing

DATA = bytes(range(256)) * 400
DIGEST = "sha256:" + hashlib.sha256(DATA).hexdigest()
OK = b"HTTP/1.1 200 OK\r\n"
WHOLE = OK + b"Content-Length: 102400\r\n\r\n"
CHUNKED = OK + b"Transfer-Encoding: chunked\r\n\r\n"


def redirect(target: str) -> bytes:
    return b"HTTP/1.1 302 Found\r\nLocation: " + target.encode() + b"\r\n\r\n"


ANSWERS: dict[str, list[bytes]] = {
    "noise": [os.urandom(10_000)],
    "a head of 10 MB": [OK, b"A: " + b"x" * 10_000_000],
    "too many bytes": [OK + b"\r\n", DATA, DATA],
    "bytes without end": [OK + b"\r\n", b"x" * 1_000_000],
    "a chunk of 2^100": [CHUNKED, b"1" + b"0" * 25 + b"\r\n", DATA],
    "a redirection to a file": [redirect("file:///etc/hostname")],
    "a redirection to itself": [redirect("/a.bin")],
}
PARTS: dict[str, Callable[[Path], object]] = {
    "a link": lambda path: path.symlink_to("../../quick.toml"),
    "a pipe": os.mkfifo,
    "too many bytes": lambda path: path.write_bytes(DATA * 2),
}


class Server:
    """Gives each connection the same answer, whatever is asked."""

    def __init__(self, answer: list[bytes]) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        self._answer = answer
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            connection, _ = self._socket.accept()
            threading.Thread(target=self._talk, args=(connection,), daemon=True).start()

    def _talk(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection:
            connection.recv(65536)
            for part in self._answer:
                connection.sendall(part)


def served(answer: list[bytes], size: str = "102400", part: Callable[[Path], object] = nothing):
    """A manifest beside weights, with a file from a server that answers so."""

    def make(room: Path) -> None:
        server = Server(answer)
        (room / "listed").mkdir()
        line = f"a.bin  {size}  {DIGEST}  MIT  slot  http://127.0.0.1:{server.port}/a.bin\n"
        (room / "listed" / "weights_manifest.txt").write_text(line)
        (room / "out" / "w").mkdir()
        part(room / "out" / "w" / "a.bin.part")

    return make


FETCH = "weights fetch a.bin --out out/w"
ENV = {"MKPC_WEIGHTS": "listed"}
CASES = [
    *(Case("fetches", name, FETCH, served(answer), (0, 1), env=ENV) for name, answer in ANSWERS.items()),
    *(
        Case("fetches", f"{name}, of unknown size", FETCH, served(ANSWERS[name], size="?"), (1,), env=ENV)
        for name in ("too many bytes", "bytes without end")
    ),
    *(
        Case("fetches", f"{name} for the part", FETCH, served([WHOLE, DATA], part=part), (0, 1), env=ENV)
        for name, part in PARTS.items()
    ),
]
