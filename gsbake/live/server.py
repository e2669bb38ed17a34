"""Server of the live view: three paths below a token, on 127.0.0.1 only, while the run lasts.

Whoever cannot read the address cannot guess it: the token has 128 random bits. Requests for another host are refused, which keeps pages of
other sites from reaching the server under a name of theirs (DNS rebinding). Requests only read: nothing in them is written, kept or logged.
"""

from __future__ import annotations

import json
import secrets
import threading
import time
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from types import TracebackType

from gsbake.live.picture import draw_in_process, newest_source
from gsbake.live.state import LiveState

HOST = "127.0.0.1"
#: Seconds between looks for a newer picture.
INTERVAL = 3.0
#: Seconds of a request after which its connection is closed.
REQUEST_TIMEOUT = 10.0
POLICY = "; ".join((
    "default-src 'none'", "img-src 'self' data:", "connect-src 'self'", "script-src 'self'", "style-src 'self'", "base-uri 'none'",
    "form-action 'none'",
))  # fmt: skip
#: {path below the token: (file of this package, its type)}.
FILES = {"": ("page.html", "text/html; charset=utf-8"), "page.js": ("page.js", "text/javascript"), "page.css": ("page.css", "text/css")}


class LiveView:
    """A server for one run; a context, in which `address` is valid."""

    def __init__(self, state: LiveState, out: Path, transfer: str) -> None:
        self.state, self.out, self.transfer = state, out, transfer
        self.token = secrets.token_urlsafe(16)
        self._begin = time.time()
        self._picture: bytes | None = None
        self._stop = threading.Event()
        view = self

        class Handler(_Handler):
            live = view

        self._server = ThreadingHTTPServer((HOST, 0), Handler)
        self._server.daemon_threads = True
        self._threads = [
            threading.Thread(target=self._server.serve_forever, name="live view", daemon=True),
            threading.Thread(target=self._draw, name="live picture", daemon=True),
        ]

    @property
    def address(self) -> str:
        """The page's address, with the token."""
        return f"http://{HOST}:{self._server.server_port}/{self.token}/"

    @property
    def hosts(self) -> tuple[str, ...]:
        """Values of the Host header that are served."""
        return tuple(f"{name}:{self._server.server_port}" for name in (HOST, "localhost"))

    @property
    def picture(self) -> bytes | None:
        """The present picture as JPEG."""
        return self._picture

    def __enter__(self) -> LiveView:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.state.end()
        self._stop.set()
        self._server.shutdown()
        self._server.server_close()

    def _draw(self) -> None:
        """Keep the picture up to date."""
        drawn = self._begin
        while not self._stop.wait(INTERVAL):
            with suppress(OSError):
                source = newest_source(self.out, self._begin)
                if source is not None and source.time > drawn:
                    image = draw_in_process(self.out, source.path, self.transfer)
                    if image is not None:
                        self._picture, drawn = image, source.time


class _Handler(BaseHTTPRequestHandler):
    live: LiveView
    timeout = REQUEST_TIMEOUT
    server_version, sys_version = "gsbake", ""

    def do_GET(self) -> None:
        """Serve the page, its state or its picture."""
        prefix = f"/{self.live.token}/"
        known = secrets.compare_digest(self.path[: len(prefix)].encode(), prefix.encode())
        if self.headers.get("Host") not in self.live.hosts or not known:
            self._send(404, b"", "text/plain")
            return
        name = self.path[len(prefix) :].partition("?")[0]
        if name == "state.json":
            self._send(200, json.dumps(self.live.state.snapshot()).encode(), "application/json")
        elif name == "picture.jpg":
            image = self.live.picture
            self._send(404 if image is None else 200, image or b"", "image/jpeg")
        elif name in FILES:
            file, kind = FILES[name]
            self._send(200, resources.files("gsbake.live").joinpath(file).read_bytes(), kind)
        else:
            self._send(404, b"", "text/plain")

    def _send(self, code: int, content: bytes, kind: str) -> None:
        headers = {
            "Content-Type": kind, "Content-Length": str(len(content)), "Cache-Control": "no-store", "Content-Security-Policy": POLICY,
            "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer",
        }  # fmt: skip
        with suppress(OSError):  # the browser went away
            self.send_response(code)
            for key, value in headers.items():
                self.send_header(key, value)
            self.end_headers()
            self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Nothing of a request is logged."""
