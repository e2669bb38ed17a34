"""The COLMAP process ends with the code of a passing fault even where its log cannot be written."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from gsbake.errors import InterruptedRun
from gsbake.python_process import python_command, python_environment


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_under_the_log(tmp_path: Path) -> None:
    """Whatever fails: where the message about it cannot be written, the disk is at fault, and the run may be tried again."""
    file = tmp_path / "job.json"
    file.write_text(json.dumps({"seed": 0, "task": "solve"}))
    command = python_command("-m", "gsbake.capture.sfm.worker", str(file), str(os.getpid()))
    with Path("/dev/full").open("wb") as sink:
        code = subprocess.call(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=sink, env=python_environment())
    assert code == InterruptedRun.exit_code
