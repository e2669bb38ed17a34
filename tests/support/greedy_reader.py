"""A child that takes as much memory as it is asked to, under a limit; see `gsbake.limited_process`."""

from __future__ import annotations

from typing import Any

from gsbake.limited_process import limit_memory, serve


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """The length of what it took."""
    limit_memory(int(request["limit"]))
    return {"bytes": len(bytearray(int(request["bytes"])))}


def main() -> None:
    """Answer requests until the parent closes the pipe."""
    serve(answer)
