"""The cluster, small captures, and the bytes of their plain runs.

GSBAKE_SLURM_REFERENCE names a folder that keeps captures and plain runs between test sessions.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.slurm.batches import plain_runs, write_captures
from tests.slurm.cluster import Cluster, SlurmUnavailable


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """Two nodes of one core; skips where Slurm cannot start."""
    pytest.importorskip("snakemake_executor_plugin_slurm")
    made = Cluster(tmp_path_factory.mktemp("slurm"))
    try:
        made.start()
    except SlurmUnavailable as error:
        made.stop()
        pytest.skip(f"Slurm cannot start here: {error}")
    yield made
    made.stop()


@pytest.fixture(scope="session")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of captures and plain runs."""
    kept = os.environ.get("GSBAKE_SLURM_REFERENCE")
    return Path(kept) if kept else tmp_path_factory.mktemp("reference")


@pytest.fixture(scope="session")
def captures(reference: Path) -> list[Path]:
    """Two built-in captures."""
    return write_captures(reference / "captures", 2)


@pytest.fixture(scope="session")
def plain(captures: list[Path], reference: Path) -> dict[str, dict[str, str]]:
    """{capture: digests} of plain runs."""
    return plain_runs(captures, reference / "plain")
