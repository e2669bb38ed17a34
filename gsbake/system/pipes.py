"""The two pipes between a parent and its child: the child's standard input and output, in lines.

Libraries print to standard output, so a child takes both ends for itself before it imports any. Windows passes no other descriptors on,
and cannot wait for a pipe with a time limit: the parent reads in a thread.
"""

from __future__ import annotations

import os
import queue
import sys
import threading
import time
from typing import IO, BinaryIO


def take_standard_streams(*, quiet: bool = False) -> tuple[BinaryIO, BinaryIO]:
    """The child's ends: what was standard input, and what was standard output.

    Afterwards standard input is empty, so that no other child takes lines from it, and what is printed goes to standard error, or nowhere
    with `quiet`.
    """
    sys.stdout.flush()
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 0)
    os.dup2(nowhere if quiet else 2, 1)
    os.close(nowhere)
    return requests, answers


class LineReader:
    """The parent's end: complete lines of a pipe. The last one is dropped when the child ended within it."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._read, name="pipe", daemon=True)
        self._thread.start()
        #: Whether the child has closed its end, and all lines were taken.
        self.ended = False

    def _read(self) -> None:
        try:
            for line in self._stream:
                if line.endswith(b"\n"):
                    self._lines.put(line)
        finally:
            self._lines.put(b"")

    def line(self, timeout: float) -> bytes | None:
        """The next line, with its line break; None after `timeout` seconds, and at the end (`ended`)."""
        if self.ended:
            return None
        try:
            line = self._lines.get(timeout=timeout) if timeout > 0 else self._lines.get_nowait()
        except queue.Empty:
            return None
        self.ended = not line
        return line or None

    def lines(self, timeout: float) -> list[bytes]:
        """All lines that are there; when there is none, the first that comes within `timeout` seconds."""
        found = []
        line = self.line(timeout)
        while line is not None:
            found.append(line)
            line = self.line(0.0)
        return found

    def last_lines(self, timeout: float) -> list[bytes]:
        """All lines until the end, of a child that has ended; at most `timeout` seconds, should another process hold its pipe."""
        found, deadline = [], time.monotonic() + timeout
        while not self.ended and (left := deadline - time.monotonic()) > 0:
            found += self.lines(left)
        self.ended = True
        return found

    def close(self) -> None:
        """Close the pipe of a child that has ended."""
        self._thread.join(1.0)
        if not self._thread.is_alive():  # another process holds the other end
            self._stream.close()
