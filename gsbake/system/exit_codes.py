"""What the exit code of a child says: it crashed, it was killed, it was asked to stop, or it ended by itself.

POSIX gives the signal as a negative code; Windows gives an NTSTATUS of at least 2³¹ for a crash. Both are read on every system.
"""

from __future__ import annotations

import signal
from dataclasses import dataclass

#: Signals that a fault of the code raises; any other comes from outside.
_FAULTS = ("SIGSEGV", "SIGBUS", "SIGABRT", "SIGFPE", "SIGILL", "SIGTRAP", "SIGSYS")
#: Signals that ask a process to stop.
_REQUESTS = ("SIGTERM", "SIGINT", "SIGHUP")
#: NTSTATUS codes with which Windows ends a process, as the signals that mean the same.
_STATUS = {
    0xC0000005: "SIGSEGV", 0xC00000FD: "SIGSEGV", 0xC0000006: "SIGBUS", 0xC0000374: "SIGABRT", 0xC0000409: "SIGABRT", 0xC000001D: "SIGILL",
    0xC0000094: "SIGFPE", 0xC000008E: "SIGFPE", 0x80000003: "SIGTRAP", 0xC000013A: "SIGINT",
}  # fmt: skip


@dataclass(frozen=True)
class ExitCode:
    """A child's exit code and the name of the signal that it stands for, empty when the child ended by itself."""

    code: int
    signal: str

    @staticmethod
    def of(code: int) -> ExitCode:
        """Read the `returncode` of a child."""
        if code >= 1 << 31:
            return ExitCode(code, _STATUS.get(code, f"status 0x{code:08X}"))
        if code < 0:
            known = {number.value: number.name for number in signal.Signals}
            return ExitCode(code, known.get(-code, f"signal {-code}"))
        return ExitCode(code, "")

    @property
    def crashed(self) -> bool:
        """Whether a fault of its own code ended the child."""
        return self.signal in _FAULTS or self.signal.startswith("status")

    @property
    def requested(self) -> bool:
        """Whether a request to stop ended it, before it could handle one."""
        return self.signal in _REQUESTS

    @property
    def killed(self) -> bool:
        """Whether it was killed, as the kernel does when memory runs out."""
        return self.signal == "SIGKILL"

    def __str__(self) -> str:
        """SIGSEGV, or "exit code 3"."""
        return self.signal or f"exit code {self.code}"
