"""Ratios of rounds with known times."""

from __future__ import annotations

import subprocess
import sys

import pytest

from benchmarks.batch import Row, ratios, summary


def test_ratios_of_a_round() -> None:
    rows = [
        Row(0, "loop", 4, 100.0, 90.0, 100.0, 1.0, 0.0),
        Row(0, "one", 4, 110.0, 99.0, 99.0, 0.9, 0.0),
        Row(0, "two", 4, 60.0, 99.0, 108.0, 0.9, 0.0),
    ]
    (found,) = ratios(rows)
    assert found.overhead == pytest.approx(0.1) and found.gaps == pytest.approx(0.1)
    assert found.workers == pytest.approx(2.0)  # no slower side by side, and as busy
    assert found.wall_overhead == pytest.approx(0.1) and found.wall_workers == pytest.approx(110 / 60)
    assert "+10.0% (+10.0% to +10.0%)" in summary([found])


@pytest.mark.skipif(sys.platform != "linux", reason="processes adopt orphans on Linux only")
def test_processes_that_nobody_waits_for_are_counted() -> None:
    """A command whose child does the work and outlives it, in a process of its own: adopting orphans lasts."""
    work = "import time; t = time.process_time()\nwhile time.process_time() - t < 0.6: pass"
    command = [sys.executable, "-c", f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {work!r}])"]
    script = f"from benchmarks.batch import timed; print(timed({command!r})[1])"
    assert float(subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout) > 0.6
