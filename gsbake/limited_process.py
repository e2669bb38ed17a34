"""Python children that parse untrusted files: with a limit on memory and time, so that a hostile file costs a sentence, not the machine.

A parser in native code may loop, exhaust memory or crash. In a child, each of these is an exit status.
"""

from __future__ import annotations

import json
import resource
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gsbake.python_process import python_command, python_environment


@dataclass(frozen=True)
class Limits:
    """Limits of a child: address space in bytes, and seconds of wall-clock time."""

    memory: int = 4 << 30
    seconds: float = 300.0


class ParserFailedError(Exception):
    """The child ended without a result; the message says why."""


def run_limited(module: str, arguments: Sequence[str], limits: Limits) -> dict[str, Any]:
    """Run `python -m module arguments` under limits and return the JSON object that it prints as its last line.

    The module's main calls `apply_limits` first. Raises ParserFailedError when the child reports an error ({"error": "…"}), crashes, or
    exceeds a limit.
    """
    command = python_command("-m", module, str(limits.memory), *arguments)
    child = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=python_environment(), start_new_session=True
    )
    try:
        out, err = child.communicate(timeout=limits.seconds)
    except subprocess.TimeoutExpired:
        raise ParserFailedError(f"reading it takes longer than {limits.seconds:.0f} s") from None
    finally:
        if child.poll() is None:
            child.kill()
            child.communicate()
    if child.returncode < 0:
        raise ParserFailedError(f"its reader was ended by {signal.Signals(-child.returncode).name}")
    try:
        answer = json.loads(out.decode(errors="replace").splitlines()[-1])
    except (ValueError, IndexError):
        lines = err.decode(errors="replace").strip().splitlines()
        reason = lines[-1] if lines else f"exit code {child.returncode}"
        memory = "MemoryError" in reason or "bad_alloc" in reason
        raise ParserFailedError(f"reading it needs more than {limits.memory / 1e9:.0f} GB" if memory else reason[:200]) from None
    if not isinstance(answer, dict) or "error" in answer:
        raise ParserFailedError(str(answer["error"] if isinstance(answer, dict) else "no result")[:300])
    return answer


def apply_limits(memory: int) -> None:
    """Limit this process's address space to `memory` bytes beyond what it has mapped, and forbid core dumps."""
    with open("/proc/self/statm", encoding="ascii") as file:
        mapped = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + memory, mapped + memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def print_answer(result: dict[str, Any]) -> None:
    """Print the result of a child as its last line."""
    sys.stdout.write(json.dumps(result) + "\n")
    sys.stdout.flush()
