"""The budget of memory for reading: from what is free, and within the limits of the process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from gsbake.errors import BadInputError
from gsbake.limited_process import ParserProcess, read_in_child
from gsbake.memory_budget import MAXIMUM, MINIMUM, SHARE, budget, check, child_limit, json_bytes, read_bytes
from gsbake.python_process import python_command, python_environment
from tests.support.large_files import many_primitives, sparse_file, write_json


@pytest.mark.parametrize(("available", "expected"), [(0, MINIMUM), (4 << 30, int(SHARE * (4 << 30))), (1 << 50, MAXIMUM)])
def test_a_share_of_what_is_free(monkeypatch: pytest.MonkeyPatch, available: int, expected: int) -> None:
    monkeypatch.setattr("gsbake.memory_budget.available_memory", lambda: available)
    assert budget() == expected


def test_a_child_never_gets_more_than_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsbake.memory_budget.available_memory", lambda: 3 << 30)
    assert child_limit(1 << 30, 1 << 30) == 2 << 30
    assert child_limit(161 << 30, 1 << 30) == 3 << 30


def test_what_is_refused_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("gsbake.memory_budget.available_memory", lambda: 2_000_000_000)
    check(1_500_000_000, "a.glb")
    with pytest.raises(BadInputError, match=r"^a\.glb needs 1\.6 GB of memory to be read, and 1\.5 GB may be used; reduce it"):
        check(1_600_000_000, "a.glb")
    with pytest.raises(BadInputError, match="more than a petabyte"):
        check(10**400, "a.glb")
    with pytest.raises(BadInputError, match=r"a\.bin' needs 1e\+03 GB"):
        read_bytes(sparse_file(tmp_path / "a.bin"))


@pytest.mark.parametrize(
    "text",
    [
        "[" * 50 + "]" * 50, '{"a":{"b":[1,2.5,"x",null]}}', f"[{'[],' * 1000}0]", f"[{'{},' * 1000}0]",
        '{"k":' * 50 + "1" + "}" * 50, '["x","y"]',
    ],
)  # fmt: skip
def test_json_takes_no_more_than_is_counted(text: str) -> None:
    def size(value: object) -> int:
        inner = [*value.keys(), *value.values()] if isinstance(value, dict) else value if isinstance(value, list) else []
        return sys.getsizeof(value) + sum(map(size, inner))

    assert size(json.loads(text)) <= json_bytes(text.encode())


def given(memory: int) -> str:
    """Lines of a script whose process was given an address space of `memory` bytes from outside (ulimit -v)."""
    return f"import resource\nresource.setrlimit(resource.RLIMIT_AS, ({memory}, resource.getrlimit(resource.RLIMIT_AS)[1]))\n"


def test_a_limit_of_the_process_counts() -> None:
    """In a process of its own, which may map 600 MB more than it has."""
    script = f"{given(600 << 20)}from gsbake.system.limits import available_memory\nprint(available_memory() <= 600 << 20)"
    done = subprocess.run(python_command("-c", script), env=python_environment(), capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "True", done.stderr


def test_inspect_under_a_limit_ends_in_a_sentence(tmp_path: Path) -> None:
    """A file of 5 kB whose primitives take gigabytes, in a process that may map 2 GB: exit code 42, not a MemoryError."""
    path = write_json(tmp_path / "a.gltf", many_primitives(200_000, 100))
    assert path.stat().st_size < 6000
    script = f"{given(2 << 30)}import sys\nsys.argv = ['gsbake', 'inspect', {str(path)!r}]\nfrom gsbake.cli import main\nmain()"
    done = subprocess.run(python_command("-c", script), env=python_environment(), capture_output=True, text=True, timeout=60)
    assert done.returncode == 42 and "a.gltf' needs" in done.stderr and "Traceback" not in done.stderr, done.stderr


def test_a_child_that_takes_more_than_its_limit_is_the_files_fault() -> None:
    with ParserProcess("tests.support.greedy_reader") as child, pytest.raises(BadInputError, match=r"^a\.png takes more memory"):
        read_in_child(child, {"bytes": 4 << 30, "limit": 1 << 30}, 60, "a.png")
