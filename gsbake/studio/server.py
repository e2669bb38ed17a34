"""The studio's server on 127.0.0.1: uvicorn in a thread, from the first request to the last one that somebody waits for."""

from __future__ import annotations

import asyncio
import importlib.util
import secrets
import socket
import threading
from types import TracebackType
from urllib.parse import quote

from gsbake.errors import UsageError
from gsbake.studio.workspace import Workspace

#: Modules that the extra `studio` brings.
MODULES = ("starlette", "uvicorn")
#: Seconds of an idle connection, open connections, and seconds that requests have when the server ends.
KEEP_ALIVE, MAX_CONNECTIONS, LAST_SECONDS = 15, 64, 2


def require_packages() -> None:
    """Raise UsageError where the extra is not installed."""
    missing = [name for name in MODULES if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(f"The studio needs {' and '.join(missing)}, not installed here: pip install 'gsbake[studio]'.")


class Studio:
    """A server for a workspace; a context, in which `address` is valid. Raises UsageError where the extra is not installed."""

    def __init__(self, workspace: Workspace, port: int = 0, *, run: str = "") -> None:
        """`run` names the capture at whose run the page opens; without it the page lists all."""
        require_packages()
        import uvicorn

        from gsbake.studio.app import guarded_app
        from gsbake.studio.security import HOST
        from gsbake.studio.services import Services

        self.token = secrets.token_urlsafe(16)
        self._place = f"#/{quote(run, safe='')}/run" if run else ""
        self._socket = socket.socket(proto=socket.IPPROTO_TCP)  # asyncio sends at once only where the protocol is named
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((HOST, port))
            self._socket.listen(MAX_CONNECTIONS)  # who comes before uvicorn waits
        except OSError as error:
            self._socket.close()
            raise UsageError(f"Port {port} cannot be used ({error.strerror}); name another with --port.") from error
        self.host, self.port = self._socket.getsockname()
        self._services = Services()
        config = uvicorn.Config(
            guarded_app(workspace, self._services, self.token, self.port), http="h11", ws="none", lifespan="off",
            log_config=None, log_level="critical",
            access_log=False, server_header=False, date_header=False, timeout_keep_alive=KEEP_ALIVE, limit_concurrency=MAX_CONNECTIONS,
            timeout_graceful_shutdown=LAST_SECONDS,
        )  # fmt: skip
        studio = self

        class Server(uvicorn.Server):
            async def main_loop(self) -> None:
                await studio._idle()

        self._server = Server(config)
        self._ready = threading.Event()
        self._end: tuple[asyncio.AbstractEventLoop, asyncio.Event] | None = None
        self._thread = threading.Thread(target=self._serve, name="studio", daemon=True)

    @property
    def address(self) -> str:
        """The page's address, with the token."""
        return f"http://{self.host}:{self.port}/?token={self.token}{self._place}"

    def wait(self) -> None:
        """Serve until the thread ends, or an exception such as that of Ctrl-C."""
        while self._thread.is_alive():
            self._thread.join(3600)

    def __enter__(self) -> Studio:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ready.wait()
        if self._end is not None:
            loop, event = self._end
            loop.call_soon_threadsafe(event.set)
        self._thread.join()
        self._services.close()
        self._socket.close()

    def _serve(self) -> None:
        try:
            self._server.run([self._socket])
        finally:
            self._ready.set()

    async def _idle(self) -> None:
        """Wait for the end, in place of uvicorn's loop, which wakes ten times a second."""
        event = asyncio.Event()
        self._end = asyncio.get_running_loop(), event
        self._ready.set()
        await event.wait()
