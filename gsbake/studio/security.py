"""What a request needs to be answered: this machine's address, the token, and for changes the page's own origin.

The server listens on loopback. Whoever cannot read the address cannot guess its token of 128 random bits; the first request with it gets a
cookie, which other sites' pages cannot make a browser send along (SameSite). Requests for another host are refused, which keeps pages of
other sites from reaching the server under a name of theirs (DNS rebinding); so are changes from another origin.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

HOST = "127.0.0.1"
#: Parameter of the address that has the token.
TOKEN = "token"
#: Methods that change nothing.
SAFE_METHODS = frozenset({"GET", "HEAD"})
#: Headers of every answer; an answer may set its own policy.
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


def policy(styles: Iterable[str] = ()) -> str:
    """Content security policy of the page: its own files, and the style sheets with these digests, which the 3D viewer puts into it."""
    return "; ".join((
        "default-src 'none'", "script-src 'self' 'wasm-unsafe-eval'", " ".join(("style-src 'self'", *styles)), "img-src 'self' data: blob:",
        "connect-src 'self' data: blob:", "base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'",
    ))  # fmt: skip


class Guard:
    """ASGI middleware that answers only requests that may be answered."""

    def __init__(self, app: ASGIApp, token: str, port: int, page_policy: str) -> None:
        self.app, self.token, self.page_policy = app, token, page_policy
        self.hosts = frozenset(f"{name}:{port}" for name in (HOST, "localhost"))
        self.cookie = f"gsbake-studio-{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it."""
        if scope["type"] != "http":
            return

        code, logged_in = self._judge(scope)

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if logged_in:
                    headers.append("Set-Cookie", f"{self.cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/")
                for key, value in {**HEADERS, "Content-Security-Policy": self.page_policy}.items():
                    headers.setdefault(key, value)
            await send(message)

        await (self.app if code == 200 else PlainTextResponse("", code))(scope, receive, send_guarded)

    def _judge(self, scope: Scope) -> tuple[int, bool]:
        """The code of a refusal, 200 for a request that is passed on; and whether it showed the token, which gives it the cookie."""
        headers, method = Headers(scope=scope), scope["method"]
        if headers.get("host") not in self.hosts:
            return 404, False
        if method not in SAFE_METHODS and headers.get("origin") not in {f"http://{host}" for host in self.hosts}:
            return 403, False
        if self._same(self._cookie(headers)):
            return 200, False
        query = scope["query_string"].decode("latin-1")
        if method == "GET" and scope["path"] == "/" and query.startswith(f"{TOKEN}=") and self._same(query[len(TOKEN) + 1 :]):
            return 200, True
        return 404, False

    def _cookie(self, headers: Headers) -> str:
        try:
            found = SimpleCookie(headers.get("cookie", "")).get(self.cookie)
        except CookieError:
            return ""
        return "" if found is None else found.value

    def _same(self, given: str) -> bool:
        return secrets.compare_digest(given.encode(errors="replace"), self.token.encode())
