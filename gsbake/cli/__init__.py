"""Command line. Large libraries are imported only by the commands that need them."""

from __future__ import annotations

import io
import signal
import sys
import warnings
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsbake.errors import GsbakeError

#: How Python writes a warning.
_standard_format = warnings.formatwarning


def main() -> None:
    """Entry point of `gsbake`: exits with a documented code (0, 2, 3, 42, 75; 1 for an internal error) and one sentence on stderr."""
    from gsbake.errors import GsbakeError, InterruptedRun

    def interrupted(number: int, frame: FrameType | None) -> None:
        raise InterruptedRun("Stopped on request; the same command resumes.")

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a Windows console may not have every character
    warnings.formatwarning = _format_warning
    signal.signal(signal.SIGINT, interrupted)
    signal.signal(signal.SIGTERM, interrupted)
    try:
        from gsbake.cli.app import parser

        code = parser()(standalone_mode=False)
    except GsbakeError as error:
        _exit_with_error(str(error), error.exit_code)
    except BrokenPipeError:
        sys.stderr.close()  # the reader of stdout closed the pipe: suppress Python's own message
        raise SystemExit(1) from None
    except Exception as error:
        if (usage := _usage_error(error)) is not None:
            _exit_with_error(usage, 2)
        if isinstance(error, OSError) and (refusal := _path_error(error)) is not None:
            _exit_with_error(str(refusal), refusal.exit_code)
        _exit_with_error(_save_traceback(error), 1)
    else:
        raise SystemExit(code if isinstance(code, int) else 0)


def _format_warning(message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None) -> str:
    """One line for a warning to the user; others as Python has them, with the place in the code."""
    from gsbake.errors import RenamedValueWarning

    if issubclass(category, RenamedValueWarning):
        return f"gsbake: warning: {message}\n"
    return _standard_format(message, category, filename, lineno, line)


def _exit_with_error(message: str, code: int) -> None:
    """Print the error, with --json as JSON too, and exit."""
    from gsbake.cli.output import print_json, print_text

    if "--json" in sys.argv[1:]:
        print_json({"error": message, "exit_code": code}, indent=None)
    print_text(f"gsbake: {message}", error=True)
    raise SystemExit(code)


def _usage_error(error: Exception) -> str | None:
    """The sentence of an error that the argument parser found; None for any other. Without arguments the help is printed instead."""
    from typer import BadParameter

    if not isinstance(error, BadParameter.__mro__[2]):  # ClickException, whose module differs between versions of typer
        return None
    found: Any = error
    if type(error).__name__ == "NoArgsIsHelpError":
        found.show()
        raise SystemExit(2)
    context = getattr(error, "ctx", None)
    text = found.format_message().strip().rstrip(".?")
    return f"{text}; see `{context.command_path} --help`." if context is not None else f"{text}."


def _path_error(error: OSError) -> GsbakeError | None:
    from gsbake.pipeline.files import path_error

    return path_error(error)


def _save_traceback(error: Exception) -> str:
    import tempfile
    import traceback

    with tempfile.NamedTemporaryFile(
        "w", encoding="utf-8", errors="backslashreplace", prefix="gsbake-error-", suffix=".txt", delete=False
    ) as file:
        file.write("".join(traceback.format_exception(error)))
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return f"Internal error ({text[:300]}); the traceback is in '{file.name}'."
