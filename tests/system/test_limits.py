"""Limits of the memory of a process."""

from __future__ import annotations

import subprocess
import sys

import pytest

SCRIPT = """
from gsbake.system.limits import available_memory, limit_address_space
before = available_memory()
print(not limit_address_space(1 << 28) or available_memory() > 0.5 * before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="no such limit here")
def test_a_small_photo_first_does_not_limit_a_large_one_later() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"
