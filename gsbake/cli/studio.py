"""`gsbake studio`: the page over a folder of captures."""

from __future__ import annotations

import webbrowser
from contextlib import suppress
from pathlib import Path

from gsbake.cli.output import print_text
from gsbake.errors import InterruptedRun
from gsbake.studio.server import Studio
from gsbake.studio.workspace import Folder


def studio(folder: Path, port: int, *, browser: bool) -> None:
    """Serve the page until Ctrl-C; its address goes to stdout."""
    with Studio(Folder(folder), port) as server:
        print_text(f"Studio: {server.address}")
        if browser:
            webbrowser.open(server.address)
        with suppress(InterruptedRun):  # Ctrl-C is how it ends
            server.wait()
