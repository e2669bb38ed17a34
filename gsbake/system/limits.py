"""Processors, memory and identity of this machine and process, and limits on this process."""

from __future__ import annotations

import importlib
import platform
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

#: The limit of the address space that this process was given, once `limit_address_space` has set one of its own, from which no later one
#: may be derived.
_given_limit: list[int] = []


def usable_processors() -> int:
    """Number of logical processors that this process may use: all, or those of its CPU affinity where the system has one."""
    with suppress(AttributeError, psutil.Error):
        return max(1, len(psutil.Process().cpu_affinity()))
    return psutil.cpu_count() or 1


def peak_memory() -> int:
    """Peak resident memory of this process in bytes, without that of the process it was forked from (getrusage includes it)."""
    with suppress(OSError):
        found = re.search(r"^VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text(encoding="ascii", errors="replace"), re.MULTILINE)
        if found:
            return int(found.group(1)) * 1024
    memory = psutil.Process().memory_info()
    with suppress(AttributeError):
        return int(memory.peak_wset)  # Windows
    resource = _resource()
    if resource is None:
        return int(memory.rss)
    peak = int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return peak if platform.system() == "Darwin" else peak * 1024


def available_memory() -> int:
    """Bytes that this process may take: what the machine has free, its container (control group) leaves, its address space allows."""
    found = [int(psutil.virtual_memory().available)]
    found += [max(0, limit - used) for limit, used in _group_memory()]
    resource = _resource()
    if resource is not None and (limit := _address_space_given(resource)) != resource.RLIM_INFINITY:
        found.append(max(0, limit - int(psutil.Process().memory_info().vms)))
    return min(found)


def _address_space_given(resource: Any) -> int:
    """The limit of the address space from outside, in bytes; RLIM_INFINITY without one."""
    return _given_limit[0] if _given_limit else int(resource.getrlimit(resource.RLIMIT_AS)[0])


def _group_memory() -> list[tuple[int, int]]:
    """(limit, memory in use without the file cache) of the control groups (version 2) that this process is in, of those with a limit."""
    found: list[tuple[int, int]] = []
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/cgroup").read_text(encoding="ascii", errors="replace").splitlines()
        inner = Path("/sys/fs/cgroup") / next(line for line in lines if line.startswith("0::"))[3:].strip("/")
        for group in (inner, *inner.parents):
            if not group.is_relative_to("/sys/fs/cgroup"):
                break
            with suppress(OSError, ValueError):  # "max" is no limit
                limit = int((group / "memory.max").read_text(encoding="ascii"))
                cached = re.search(r"^inactive_file (\d+)", (group / "memory.stat").read_text(encoding="ascii"), re.MULTILINE)
                used = int((group / "memory.current").read_text(encoding="ascii")) - (int(cached.group(1)) if cached else 0)
                found.append((limit, max(0, used)))
    return found


def limit_address_space(memory: int) -> bool:
    """Limit this process's address space to `memory` bytes beyond what it has mapped; a later call replaces the limit.

    False where the system does not do that: macOS ignores the limit, Windows has none.
    """
    resource = _resource()
    if resource is None:
        return False
    try:
        mapped = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    except OSError:
        return False
    given, highest = _address_space_given(resource), resource.getrlimit(resource.RLIMIT_AS)[1]
    limit = mapped + memory if given == resource.RLIM_INFINITY else min(mapped + memory, given)
    resource.setrlimit(resource.RLIMIT_AS, (limit, highest))
    _given_limit[:] = [given]
    return True


def write_no_core() -> None:
    """A crash of this process leaves no file with its memory."""
    resource = _resource()
    if resource is not None:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def boot_id() -> str:
    """Identifier of the machine's current boot."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return f"boot-{psutil.boot_time():.0f}"


def cpu_name() -> str:
    """Model name of the processor."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _resource() -> Any:
    """The module `resource`; None on Windows."""
    try:
        return importlib.import_module("resource")
    except ImportError:
        return None
