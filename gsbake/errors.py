"""Errors shown to the user, each with its documented exit code (0 done, 2 usage, 42 bad input, 75 interrupted)."""

from __future__ import annotations

from gsbake.text import printable


class GsbakeError(Exception):
    """Base: the message is one printable sentence that says what is wrong, where, and what to do."""

    exit_code = 1

    def __init__(self, message: str = "") -> None:
        super().__init__(printable(message))


class RenamedValueWarning(FutureWarning):
    """A setting has a value by its old name, which the next version refuses."""


class UsageError(GsbakeError):
    """The command or profile was used wrongly (exit code 2)."""

    exit_code = 2


class BadInputError(GsbakeError):
    """The data cannot be used; retrying will not help (exit code 42)."""

    exit_code = 42


class InterruptedRun(GsbakeError):
    """Stopped on request or by a fault that may pass (kill, memory, full or failing disk): the same command resumes (exit code 75)."""

    exit_code = 75
