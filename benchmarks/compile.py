"""What each declared kernel costs to compile: seconds and lines of optimised LLVM IR.

    python -m benchmarks.compile [MODULE …]

Every kernel is compiled in this process, without Numba's cache, so that the seconds of functions that several kernels share count for the
first of them.
"""

from __future__ import annotations

import argparse
import os
import re
import tempfile
import time

from gsbake.config.load import load_profile
from gsbake.kernels.declaration import declared
from gsbake.stages import REGISTRY


def measure(module: str) -> list[tuple[str, float, int]]:
    """(kernel, seconds, lines of LLVM IR) of the kernels of one module."""
    rows = []
    for dispatcher, types in declared(module):
        start = time.process_time()
        dispatcher.compile(types)
        seconds = time.process_time() - start
        text = next(iter(dispatcher.inspect_llvm().values()))
        rows.append((f"{module.removeprefix('gsbake.')}.{dispatcher.py_func.__name__}", seconds, len(re.findall(r"^  \S", text, re.M))))
    return rows


def main() -> None:
    """Print the kernels, the slowest first, and the sum."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", help="modules with kernels; default: those of all stages of `relight`")
    settings = load_profile("relight").profile
    wanted = parser.parse_args().modules or [name for stage in REGISTRY.up_to() for name in stage.kernels(settings)]
    rows = [row for module in dict.fromkeys(wanted) for row in measure(module)]
    print(f"{'kernel':<60} {'seconds':>8} {'LLVM IR':>8}")
    for name, seconds, lines in sorted(rows, key=lambda row: -row[1]):
        print(f"{name:<60} {seconds:8.2f} {lines:8d}")
    print(f"{'sum':<60} {sum(row[1] for row in rows):8.2f} {sum(row[2] for row in rows):8d}")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.environ["NUMBA_CACHE_DIR"] = folder
        main()
