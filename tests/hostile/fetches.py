"""Servers that lie or wander: ``weights fetch`` from a server of the test's own."""

import hashlib
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from socketserver import BaseRequestHandler, ThreadingTCPServer

from attack import Case, Make, nothing
from room import written

DATA = bytes(range(256)) * 400
DIGEST = "sha256:" + hashlib.sha256(DATA).hexdigest()
OK = b"HTTP/1.1 200 OK\r\n"
REDIRECTION = b"HTTP/1.1 302 Found\r\nLocation: %b\r\n\r\n"
ANSWERS = {  # the first is refused at once, and not asked for again
    "too many bytes": OK + b"\r\n" + DATA * 10,
    "noise": os.urandom(10_000),
    "a head of 10 MB": OK + b"A: " + b"x" * 10_000_000,
    "a chunk of 2^100": OK + b"Transfer-Encoding: chunked\r\n\r\n1" + b"0" * 25 + b"\r\n" + DATA,
    "a redirection to a file": REDIRECTION % b"file:///etc/hostname",
    "a redirection to itself": REDIRECTION % b"/a.bin",
}
PARTS = {
    "a link": lambda path: path.symlink_to("../../quick.toml"),
    "a pipe": os.mkfifo,
    "too many bytes": lambda path: path.write_bytes(DATA * 2),
}


def serve(answer: bytes) -> int:
    """Give each connection the same answer, whatever it asks. Return the port."""

    class Handler(BaseRequestHandler):
        def handle(self) -> None:
            self.request.recv(65536)
            with suppress(OSError):
                self.request.sendall(answer)

    server = ThreadingTCPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server.server_address[1]


def served(answer: bytes, size: str = "102400", part: Callable[[Path], object] = nothing) -> Make:
    def make(room: Path) -> None:
        source = f"http://127.0.0.1:{serve(answer)}/a.bin"
        written("listed/weights_manifest.txt", f"a.bin  {size}  {DIGEST}  MIT  slot  {source}\n")(room)
        (room / "out" / "w").mkdir()
        part(room / "out" / "w" / "a.bin.part")

    return make


FETCH, ENV = "weights fetch a.bin --out out/w", {"MKPC_WEIGHTS": "listed"}
CASES = [
    *(Case("fetches", name, FETCH, served(answer), (0, 1), env=ENV) for name, answer in ANSWERS.items()),
    Case("fetches", "of unknown size", FETCH, served(ANSWERS["too many bytes"], size="?"), (1,), env=ENV),
    *(
        Case("fetches", f"{name} for the part", FETCH, served(OK + b"\r\n" + DATA, part=part), (0, 1), env=ENV)
        for name, part in PARTS.items()
    ),
]
