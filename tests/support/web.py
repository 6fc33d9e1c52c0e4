"""A local HTTP server that serves one file as a good server does, or as bad servers do."""

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import BaseRequestHandler, TCPServer, ThreadingTCPServer


@dataclass
class Site:
    """The behaviour of the server; it may be changed between requests. ``asked`` gets each request's Range
    header.
    """

    data: bytes
    breaks: list[int] = field(default_factory=list)  # bytes after which the first connections break
    statuses: list[int] = field(default_factory=list)  # errors that the first requests get
    length: int | None = None  # a Content-Length that is not true; 0: none is sent
    redirect: str = ""
    asked: list[str] = field(default_factory=list)
    sent: int = 0  # bytes of bodies
    url: str = ""


class _Handler(BaseHTTPRequestHandler):
    site: Site

    def do_GET(self) -> None:
        site = self.site
        site.asked.append(self.headers.get("Range", ""))
        if site.redirect:
            self.wfile.write(
                b"HTTP/1.1 302 Found\r\nLocation: " + site.redirect.encode() + b"\r\n\r\n"
            )
        elif site.statuses:
            self.send_error(site.statuses.pop(0))
        else:
            wanted = re.fullmatch(r"bytes=(\d+)-", site.asked[-1])
            self._send(site, int(wanted[1]) if wanted else 0)

    def _send(self, site: Site, start: int) -> None:
        body = site.data[start:]
        self.send_response(206 if start else 200)
        if start:
            self.send_header(
                "Content-Range", f"bytes {start}-{len(site.data) - 1}/{len(site.data)}"
            )
        if site.length != 0:
            self.send_header("Content-Length", str(site.length or len(body)))
        self.end_headers()
        body = body[: site.breaks.pop(0)] if site.breaks else body
        site.sent += len(body)  # before the client has them and looks
        with suppress(ConnectionError):
            self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def serve(site: Site) -> Iterator[Site]:
    with _running(
        ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"site": site}))
    ) as site.url:
        yield site


@contextmanager
def serve_bytes(answer: bytes) -> Iterator[str]:
    """Give each connection the same answer, which may be no HTTP. Yield the URL."""

    class Handler(BaseRequestHandler):
        def handle(self) -> None:
            self.request.recv(65536)
            with suppress(OSError):
                self.request.sendall(answer)

    with _running(ThreadingTCPServer(("127.0.0.1", 0), Handler)) as url:
        yield url


@contextmanager
def _running(server: TCPServer) -> Iterator[str]:
    with server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}/a.bin"
        finally:
            server.shutdown()
            thread.join()
