"""A local HTTP server that serves one file as a good server does, or as bad servers do."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Site:
    """The behaviour of the server; it may be changed between requests. ``asked`` gets each request's path."""

    data: bytes
    # Bytes after which the first connections break
    breaks: list[int] = field(default_factory=list)
    statuses: list[int] = field(default_factory=list)  # errors that the first requests get
    redirect: str = ""
    asked: list[str] = field(default_factory=list)
    url: str = ""


class _Handler(BaseHTTPRequestHandler):
    site: Site

    def do_GET(self) -> None:
        site = self.site
        site.asked.append(self.path)
        if site.redirect:
            self.send_response(302)
            self.send_header("Location", site.redirect)
            self.end_headers()
        elif site.statuses:
            self.send_error(site.statuses.pop(0))
        else:
            self.send_response(200)
            self.send_header("Content-Length", str(len(site.data)))
            self.end_headers()
            with suppress(ConnectionError):
                self.wfile.write(
                    site.data[: site.breaks.pop(0)] if site.breaks else site.data
                )

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def serve(site: Site) -> Iterator[Site]:
    handler = type("Handler", (_Handler,), {"site": site})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        site.url = f"http://127.0.0.1:{server.server_address[1]}/a.bin"
        try:
            yield site
        finally:
            server.shutdown()
            thread.join()
