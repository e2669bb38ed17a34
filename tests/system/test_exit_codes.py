"""Exit codes of children on POSIX and Windows."""

from __future__ import annotations

import signal

import pytest

from gsbake.system.exit_codes import ExitCode


@pytest.mark.parametrize(
    ("code", "text", "crashed", "requested", "killed"),
    [
        (0, "exit code 0", False, False, False),
        (3, "exit code 3", False, False, False),
        (-signal.SIGSEGV, "SIGSEGV", True, False, False),
        (-signal.SIGABRT, "SIGABRT", True, False, False),
        (-signal.SIGTERM, "SIGTERM", False, True, False),
        (-9, "SIGKILL", False, False, True),
        (-50, "signal 50", False, False, False),
        (0xC0000005, "SIGSEGV", True, False, False),
        (0xC0000409, "SIGABRT", True, False, False),
        (0xC000013A, "SIGINT", False, True, False),
        (0xC0000142, "status 0xC0000142", True, False, False),
    ],
)
def test_exit_codes(code: int, text: str, crashed: bool, requested: bool, killed: bool) -> None:
    found = ExitCode.of(code)
    assert (str(found), found.crashed, found.requested, found.killed) == (text, crashed, requested, killed)
