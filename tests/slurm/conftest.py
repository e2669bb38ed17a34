"""The cluster, small captures, and the bytes of their plain runs."""

from __future__ import annotations

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
def captures(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two built-in captures."""
    return write_captures(tmp_path_factory.mktemp("captures"), 2)


@pytest.fixture(scope="session")
def plain(captures: list[Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, str]]:
    """{capture: digests} of plain runs."""
    return plain_runs(captures, tmp_path_factory.mktemp("plain"))
