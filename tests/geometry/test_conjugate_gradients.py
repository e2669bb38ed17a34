"""Conjugate gradients against a direct solver, and their bytes with several threads of BLAS."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve

from gsbake.geometry.conjugate_gradients import conjugate_gradients


def system(count: int) -> tuple[sparse.csr_matrix, np.ndarray]:
    """A screened Laplacian of a line with uneven weights, and a right side."""
    draw = np.random.default_rng(0)
    weight = draw.uniform(0.1, 10, count)
    step = sparse.diags([-np.ones(count - 1), np.ones(count - 1)], [0, 1], shape=(count - 1, count))
    return (step.T @ step + sparse.diags(weight)).tocsr(), draw.normal(size=count)


def test_equals_the_direct_solution() -> None:
    matrix, right = system(300)
    truth = spsolve(matrix.tocsc(), right)
    assert conjugate_gradients(matrix, right, 1e-10, 300) == pytest.approx(truth, abs=1e-8)
    near = conjugate_gradients(matrix, right, 1e-10, 3, truth + 1e-6)
    assert np.abs(near - truth).max() < np.abs(conjugate_gradients(matrix, right, 1e-10, 3) - truth).max()


def test_ends_at_the_tolerance() -> None:
    matrix, right = system(300)
    found = conjugate_gradients(matrix, right, 1e-2, 300)
    assert 1e-4 < np.linalg.norm(right - matrix @ found) / np.linalg.norm(right) <= 1e-2
    assert not conjugate_gradients(matrix, np.zeros(300), 1e-2, 300).any()
    assert len(conjugate_gradients(*system(2), 1e-2, 0)) == 2
    assert not conjugate_gradients(sparse.csr_matrix((2, 2)), np.ones(2), 1e-2, 10).any()  # singular


def test_threads_of_blas_do_not_matter() -> None:
    """A vector long enough for BLAS to split it among threads."""
    program = (
        "import hashlib; from tests.geometry.test_conjugate_gradients import *; "
        "print(hashlib.sha256(conjugate_gradients(*system(60_000), 1e-6, 40).tobytes()).hexdigest())"
    )
    found = set()
    for threads in ("1", "2", "3"):
        environment = os.environ | {"OPENBLAS_NUM_THREADS": threads}
        done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
        found.add(done.stdout)
    assert len(found) == 1
