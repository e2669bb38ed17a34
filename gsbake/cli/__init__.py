"""Command line. Large libraries are imported only by the commands that need them."""

from __future__ import annotations

import signal
import sys
from types import FrameType


def main() -> None:
    """Entry point of `gsbake`: exits with a documented code (0, 2, 42, 75; 1 for an internal error) and one sentence on stderr."""
    from gsbake.errors import GsbakeError, InterruptedRun

    def interrupted(number: int, frame: FrameType | None) -> None:
        raise InterruptedRun("Stopped on request; the same command resumes.")

    signal.signal(signal.SIGINT, interrupted)
    signal.signal(signal.SIGTERM, interrupted)
    try:
        from gsbake.cli.app import app

        app()
    except GsbakeError as error:
        _exit_with_error(str(error), error.exit_code)
    except BrokenPipeError:
        sys.stderr.close()  # the reader of stdout closed the pipe: suppress Python's own message
        raise SystemExit(1) from None
    except Exception as error:
        _exit_with_error(_save_traceback(error), 1)


def _exit_with_error(message: str, code: int) -> None:
    """Print the error, with --json as JSON too, and exit."""
    from rich.console import Console

    if "--json" in sys.argv[1:]:
        import json

        sys.stdout.write(json.dumps({"error": message, "exit_code": code}, ensure_ascii=False) + "\n")
    Console(stderr=True, highlight=False, soft_wrap=True).print(f"gsbake: {message}", markup=False)
    raise SystemExit(code)


def _save_traceback(error: Exception) -> str:
    import tempfile
    import traceback

    with tempfile.NamedTemporaryFile("w", prefix="gsbake-error-", suffix=".txt", delete=False) as file:
        file.write("".join(traceback.format_exception(error)))
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return f"Internal error ({text[:300]}); the traceback is in '{file.name}'."
