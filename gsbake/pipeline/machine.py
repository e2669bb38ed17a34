"""Properties of the machine: cores, memory, GPU and library versions, found without importing heavy libraries."""

from __future__ import annotations

import ctypes
import importlib.util
import math
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
from gsbake.system.limits import cpu_name, usable_processors

#: Libraries whose versions are stored in manifests and shown by `doctor`.
LIBRARIES = (
    "gsbake", "numpy", "scipy", "numba", "torch", "pycolmap", "opencv-contrib-python-headless", "OpenImageIO", "scikit-image",
    "trimesh", "pymeshlab", "fast-simplification", "xatlas", "embreex", "safetensors", "pydantic", "blake3",
)  # fmt: skip

#: Environment variables that set the sizes of the libraries' thread pools; they are read when a library loads.
_THREAD_POOL_VARIABLES = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM", "OPENIMAGEIO_THREADS",
)  # fmt: skip


def default_threads() -> int:
    """Number of physical cores that this process may use, limited by CPU affinity and container quota."""
    return max(1, min(psutil.cpu_count(logical=False) or 1, available_cores()))


def available_cores() -> int:
    """Number of logical cores that this process may use, limited by CPU affinity and container quota."""
    limits = [usable_processors()]
    with suppress(OSError, ValueError):  # cgroup v2: "max 100000" or "150000 100000"
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="ascii").split()
        if quota != "max":
            limits.append(math.ceil(int(quota) / int(period)))
    return max(1, min(limits))


def thread_environment(threads: int) -> dict[str, str]:
    """Environment variables that set every library's thread pool to `threads` threads.

    Idle OpenMP threads sleep instead of spinning. Numba tries OpenMP first, because an installed TBB may be too old.
    """
    sizes = dict.fromkeys(_THREAD_POOL_VARIABLES, str(threads))
    return sizes | {"OMP_WAIT_POLICY": "PASSIVE", "NUMBA_THREADING_LAYER_PRIORITY": "omp workqueue tbb"}


def torch_cuda_build() -> str | None:
    """CUDA version that the installed torch was built for, read from its version file; None for a CPU build or without torch."""
    with suppress(ImportError, OSError, ValueError):
        spec = importlib.util.find_spec("torch")
        if spec is not None and spec.origin is not None:
            text = (Path(spec.origin).parent / "version.py").read_text(encoding="utf-8")
            found = re.search(r"^cuda\b[^=\n]*=\s*'([^']+)'", text, re.MULTILINE)
            return found.group(1) if found else None
    return None


def cuda_devices() -> int:
    """Number of GPUs that the NVIDIA driver reports."""
    for name in ("libcuda.so.1", "libcuda.so", "nvcuda.dll"):
        with suppress(OSError):
            driver = ctypes.CDLL(name)
            count = ctypes.c_int(0)
            if driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0:
                return count.value
            return 0
    return 0


def missing_cuda_requirement() -> str | None:
    """Why the CUDA kernels cannot run on this machine; None when they can. Imports neither torch nor Triton."""
    if torch_cuda_build() is None:
        return "torch is built for the CPU only"
    if not cuda_devices():
        return "the NVIDIA driver reports no GPU"
    if importlib.util.find_spec("triton") is None:
        return "the package triton is not installed"
    return None


def resolve_device(requested: str) -> str:
    """The device, "cpu" or "cuda", for auto|cpu|cuda. Raises UsageError when CUDA is requested but not available.

    auto is the CPU: a GPU hardly shortens a run (docs/concepts/surfels.md), so it must be requested.
    """
    if requested not in ("auto", "cpu", "cuda"):
        raise UsageError(f"--device is auto, cpu or cuda, not '{requested}'.")
    if requested != "cuda":
        return "cpu"
    missing = missing_cuda_requirement()
    if missing:
        raise UsageError(f"--device cuda is not available: {missing}; omit the option or use --device cpu.")
    return "cuda"


@cache
def versions(names: tuple[str, ...] = LIBRARIES) -> dict[str, str]:
    """{library: version} of the installed ones of `names`, and of Python."""
    out = {"python": platform.python_version()}
    for name in names:
        with suppress(metadata.PackageNotFoundError):
            out[name] = metadata.version(name)
    return out


@cache
def host_info() -> Mapping[str, Any]:
    """Properties of the machine for manifests."""
    return {
        "name": socket.gethostname(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpu": cpu_name(),
        "cores": psutil.cpu_count(logical=False) or psutil.cpu_count() or 1,
        "memory_bytes": psutil.virtual_memory().total,
    }
