"""A parser that takes more and more memory, slowly, beyond its limit of 64 MB; and one that prints before it answers."""

from __future__ import annotations

import os
import time
from typing import Any

from gsbake.limited_process import limit_memory, serve

os.write(1, b"a library that prints when it is imported\n")


def answer(request: dict[str, Any]) -> dict[str, Any]:
    if request["task"] == "echo":
        os.write(1, b"a library that prints\n")
        return {"echo": request["text"]}
    limit_memory(64 << 20)
    taken = []
    try:
        for _ in range(200):
            taken.append(b"x" * (4 << 20))
            time.sleep(0.01)
    except MemoryError:
        return {"error": "out of memory"}
    return {"megabytes": 4 * len(taken)}


def main() -> None:
    serve(answer)
