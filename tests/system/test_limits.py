"""Limits of the memory of a process."""

from __future__ import annotations

import subprocess
import sys

import pytest

OWN = """
from gsbake.system.limits import available_memory, limit_address_space
before = available_memory()
print(not limit_address_space(1 << 28) or available_memory() > 0.5 * before)
"""
GIVEN = """
import resource
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, resource.getrlimit(resource.RLIMIT_AS)[1]))
from gsbake.system.limits import available_memory, limit_address_space
limit_address_space(1 << 28)
limit_address_space(1 << 40)
print(available_memory() < 1 << 30 and resource.getrlimit(resource.RLIMIT_AS)[0] == 1 << 30)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="no such limit here")
@pytest.mark.parametrize("script", [OWN, GIVEN], ids=["a small photo first does not limit a large one later", "a limit from outside stays"])
def test_limits_of_the_address_space(script: str) -> None:
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"
