"""`gsbake doctor`: check of Python, libraries, backend, memory and disk."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import psutil
import typer

from gsbake.capture.masks.weights import INSTALL, WEIGHTS
from gsbake.cli.output import cell, print_json, print_table
from gsbake.pipeline.machine import cuda_devices, default_threads, resolve_device, torch_cuda_build, versions
from gsbake.python_process import python_command, python_environment
from gsbake.system.limits import cpu_name
from gsbake.text import size

#: {pip package: module that is imported to check it}.
MODULES = {
    "numpy": "numpy", "scipy": "scipy", "numba": "numba", "torch": "torch", "pycolmap": "pycolmap", "opencv-contrib-python-headless": "cv2",
    "OpenImageIO": "OpenImageIO", "scikit-image": "skimage.measure", "trimesh": "trimesh", "fast-simplification": "fast_simplification",
    "pymeshlab": "pymeshlab", "xatlas": "xatlas", "embreex": "embreex", "safetensors": "safetensors", "jinja2": "jinja2",
}  # fmt: skip

#: {pip package that gsbake does without: what it does then}.
OPTIONAL = {"pymeshlab": "fast-simplification decimates"}

#: {shared library: Debian package that contains it}.
DEBIAN = {
    "libGL.so": "libgl1", "libOpenGL.so": "libopengl0", "libEGL.so": "libegl1", "libGLX.so": "libglx0", "libX11.so": "libx11-6",
    "libfontconfig.so": "libfontconfig1", "libfreetype.so": "libfreetype6", "libglib-2.0.so": "libglib2.0-0", "libgomp.so": "libgomp1",
    "libxcb.so": "libxcb1", "libstdc++.so": "libstdc++6",
}  # fmt: skip

_TIMED_IMPORT = """
import sys, time, zlib
start = time.perf_counter()
__import__(sys.argv[1])
sys.stdout.write(f"seconds={time.perf_counter() - start}")
"""


@dataclass(frozen=True)
class Finding:
    """One checked item; `advice` is empty when it is fine."""

    what: str
    found: str
    ok: bool
    advice: str = ""


def doctor(as_json: bool, out: Path) -> None:
    """Print the findings; exit code 1 when a requirement is missing."""
    findings = [*machine_findings(out), *library_findings()]
    good = all(f.ok for f in findings)
    if as_json:
        print_json({"ok": good, "findings": [asdict(f) for f in findings]})
    else:
        rows = [(cell("✓" if f.ok else "✗", "green" if f.ok else "red"), f.what, f.found, f.advice) for f in findings]
        print_table(("", "what", "found", "what to do"), rows)
    if not good:
        raise typer.Exit(1)


def machine_findings(out: Path) -> list[Finding]:
    """Python, cores, memory, disk and the backend."""
    version = ".".join(map(str, sys.version_info[:3]))
    supported = (3, 11) <= sys.version_info[:2] <= (3, 13)
    memory = psutil.virtual_memory()
    place = next(p for p in (out.absolute(), *out.absolute().parents) if p.exists())
    free = shutil.disk_usage(place).free
    writable = os.access(place, os.W_OK)
    network = "installed" if WEIGHTS.is_file() else f"weights not installed, so masks are not made: run `{INSTALL}`"
    return [
        Finding("Python", version, supported, "" if supported else "use Python 3.11, 3.12 or 3.13"),
        Finding("processor", f"{cpu_name()}, {default_threads()} cores used", True),
        Finding(
            "memory", f"{size(memory.available)} of {size(memory.total)} free", memory.available > 2e9,
            "" if memory.available > 2e9 else "close other programs: preview needs about 2 GB, relight more",
        ),
        Finding(
            "disk", f"{size(free)} free in {place}{'' if writable else ', not writable'}", writable and free > 2e9,
            "" if writable and free > 2e9 else "choose another folder with --out, or free 2 GB",
        ),
        Finding("mask network", network, True),
        backend_finding(),
    ]  # fmt: skip


def backend_finding() -> Finding:
    """Backend of `--device auto`, GPUs and the build of torch."""
    build, devices = torch_cuda_build(), cuda_devices()
    gpu = f"{devices} NVIDIA GPU{'s' if devices > 1 else ''}" if devices else "no NVIDIA GPU"
    torch_build = f"torch for CUDA {build}" if build else "torch for the CPU"
    return Finding("backend", f"{resolve_device('auto')} ({gpu}, {torch_build})", True)


def library_findings() -> list[Finding]:
    """Import each library in a separate process, so that crashes are found too."""
    known = versions(tuple(MODULES))
    with ThreadPoolExecutor(2) as pool:
        tried = pool.map(_try_import, MODULES.values())
    findings = []
    for (library, _), (seconds, error) in zip(MODULES.items(), tried, strict=True):
        if seconds is not None:
            findings.append(Finding(library, f"{known.get(library, '?')}, loads in {seconds:.1f} s", True))
        elif library in OPTIONAL and library not in known:
            findings.append(Finding(library, f"not installed: {OPTIONAL[library]}", True))
        else:
            found = f"{known[library]}, does not load: {error}" if library in known else "not installed"
            findings.append(Finding(library, found, False, advice_for(library, error, installed=library in known)))
    return findings


def advice_for(library: str, error: str, *, installed: bool) -> str:
    """Advice for a library that does not load."""
    if not installed:
        return f"pip install {library} (or install gsbake again)"
    missing = re.search(r"(lib[\w.+-]+?\.so)[.\d]*: cannot open shared object file", error)
    if missing:
        package = DEBIAN.get(missing.group(1))
        return f"sudo apt-get install {package}" if package else f"install the system library {missing.group(1)}"
    return f"pip install --force-reinstall {library}"


def _try_import(module: str) -> tuple[float | None, str]:
    """Seconds the import takes, or None and the last line of its error."""
    try:
        done = subprocess.run(
            python_command("-c", _TIMED_IMPORT, module), env=python_environment(), stdin=subprocess.DEVNULL, capture_output=True,
            encoding="utf-8", errors="replace", timeout=120, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return None, "import takes more than two minutes"
    found = re.search(r"seconds=([\d.]+)", done.stdout)
    if done.returncode == 0 and found:
        return float(found.group(1)), ""
    lines = done.stderr.strip().splitlines()
    return None, lines[-1] if lines else f"exit code {done.returncode}"
