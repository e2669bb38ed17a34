"""`--view` names the page of a run, on loopback, and changes nothing else."""

from __future__ import annotations

import re
from pathlib import Path

from tests.cli.conftest import Run


def test_a_run_says_where_its_page_is(run: Run, capture: Path) -> None:
    end = run("run", capture, "--out", "o", "--view", "--quiet")
    assert end.code == 0 and re.search(r"Live view: http://127\.0\.0\.1:\d+/[\w-]{20,}/", end.err)
    assert Path("o/asset.glb").exists() and "Live view" not in run("run", "--out", "o").err
