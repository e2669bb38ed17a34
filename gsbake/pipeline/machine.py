"""The machine a run stands on: cores, memory, GPU, versions — found without importing anything heavy."""

from __future__ import annotations

import ctypes
import importlib.util
import math
import os
import platform
import re
import socket
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil

from gsbake.errors import UsageError

#: The libraries whose versions are kept in manifests and shown by `doctor`.
LIBRARIES = (
    "gsbake", "numpy", "scipy", "numba", "torch", "pycolmap", "opencv-contrib-python-headless", "OpenImageIO", "scikit-image",
    "trimesh", "pymeshlab", "xatlas", "embreex", "safetensors", "pydantic", "blake3",
)  # fmt: skip

#: Environment variables that size the thread pools of the libraries stages use; all are read when a library loads.
_POOLS = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM", "OPENIMAGEIO_THREADS",
)  # fmt: skip


def default_threads() -> int:
    """Physical cores this process may use: affinity and container quota count too."""
    limits = [psutil.cpu_count(logical=False) or psutil.cpu_count() or 1]
    if hasattr(os, "sched_getaffinity"):
        limits.append(len(os.sched_getaffinity(0)))
    with suppress(OSError, ValueError):  # cgroup v2: "max 100000" or "150000 100000"
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        if quota != "max":
            limits.append(math.ceil(int(quota) / int(period)))
    return max(1, min(limits))


def thread_environment(threads: int) -> dict[str, str]:
    """The environment in which every library's thread pool has `threads` threads.

    Idle OpenMP threads sleep instead of spinning, and Numba takes OpenMP before it looks at a TBB that may be too old.
    """
    sizes = dict.fromkeys(_POOLS, str(threads))
    return sizes | {"OMP_WAIT_POLICY": "PASSIVE", "NUMBA_THREADING_LAYER_PRIORITY": "omp workqueue tbb"}


def torch_cuda_build() -> str | None:
    """CUDA version the installed torch was built for, read from its version file; None for a CPU build or no torch."""
    with suppress(ImportError, OSError, ValueError):
        spec = importlib.util.find_spec("torch")
        if spec is not None and spec.origin is not None:
            text = (Path(spec.origin).parent / "version.py").read_text()
            found = re.search(r"^cuda\b[^=\n]*=\s*'([^']+)'", text, re.MULTILINE)
            return found.group(1) if found else None
    return None


def cuda_devices() -> int:
    """GPUs the NVIDIA driver offers."""
    for name in ("libcuda.so.1", "libcuda.so"):
        with suppress(OSError):
            driver = ctypes.CDLL(name)
            count = ctypes.c_int(0)
            if driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0:
                return count.value
            return 0
    return 0


def cuda_lacks() -> str | None:
    """What keeps the kernels from running on a GPU here, as half a sentence; None when nothing does. Imports neither torch nor Triton."""
    if torch_cuda_build() is None:
        return "torch is built for the CPU only"
    if not cuda_devices():
        return "the NVIDIA driver offers no GPU"
    if importlib.util.find_spec("triton") is None:
        return "the package triton is not installed"
    return None


def resolve_device(asked: str) -> str:
    """The device, "cpu" or "cuda", for auto|cpu|cuda. UsageError when CUDA is asked for in vain.

    auto is the CPU: the CUDA kernels have not been measured on a GPU yet (docs/cuda.md), so they are only taken when asked for.
    """
    if asked not in ("auto", "cpu", "cuda"):
        raise UsageError(f"--device is auto, cpu or cuda, not '{asked}'.")
    if asked != "cuda":
        return "cpu"
    lacks = cuda_lacks()
    if lacks:
        raise UsageError(f"--device cuda cannot be had: {lacks}; leave the option out or give --device cpu.")
    return "cuda"


@cache
def versions(names: tuple[str, ...] = LIBRARIES) -> dict[str, str]:
    """{library: version} of those installed, and of Python."""
    out = {"python": platform.python_version()}
    for name in names:
        with suppress(metadata.PackageNotFoundError):
            out[name] = metadata.version(name)
    return out


@cache
def host_facts() -> Mapping[str, Any]:
    """What a manifest says of the machine."""
    return {
        "name": socket.gethostname(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpu": cpu_name(),
        "cores": psutil.cpu_count(logical=False) or psutil.cpu_count() or 1,
        "memory_bytes": psutil.virtual_memory().total,
    }


def cpu_name() -> str:
    """Model of the processor."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def peak_memory() -> int:
    """Largest resident memory of this process so far, in bytes (not that of the process it was forked from, as getrusage would say)."""
    with suppress(OSError):
        found = re.search(r"^VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
        if found:
            return int(found.group(1)) * 1024
    import resource
    import sys

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
