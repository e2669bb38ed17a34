"""Concurrent fits where Numba has only its own threading layer, as on a Mac without OpenMP: that layer ends a process whose threads call
parallel kernels at a time."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CODE = """
import sys
import numba, numpy as np
from concurrent.futures import ThreadPoolExecutor
from gsbake.materials.concurrent_fits import run_concurrently

@numba.njit(parallel=True, nogil=True)
def kernel(values):
    for i in numba.prange(len(values)):
        values[i] = np.sin(values[i]) + 1

def fit(each):
    values = np.zeros(200_000)
    for step in range(40):
        kernel(values)
        each(step + 1, 40)
    return float(values[0])

kernel(np.zeros(4))
assert numba.threading_layer() == "workqueue", numba.threading_layer()
if sys.argv[1] == "guarded":
    found = run_concurrently([fit, fit, fit], lambda done, total: None)
else:
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(fit, [lambda done, total: None] * 3))
print(len(set(found)))
"""


@pytest.mark.parametrize("how", ["guarded", "unguarded"])
def test_fits_with_workqueue(how: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_THREADING_LAYER": "workqueue", "NUMBA_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", CODE, how], env=environment, capture_output=True, text=True, timeout=200, check=False)
    if how == "guarded":
        assert done.returncode == 0 and done.stdout == "1\n", done.stderr
    else:  # the guard is needed
        assert done.returncode != 0 and "Concurrent access" in done.stderr
