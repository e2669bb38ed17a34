"""requirements.lock: every pinned package, at its pinned version, with digests of its files."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def lock() -> ModuleType:
    spec = importlib.util.spec_from_file_location("lock", ROOT / "packaging" / "lock.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_lock_is_of_the_present_constraints(lock: ModuleType) -> None:
    entries = re.findall(r"^([A-Za-z0-9._-]+)==([^\s+;]+)", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    assert set(entries) == set(lock.pins(ROOT / "constraints.txt"))


def test_every_entry_has_digests() -> None:
    for entry in re.split(r"\n(?=\S)", (ROOT / "requirements.lock").read_text())[1:]:
        assert re.search(r"--hash=sha256:[0-9a-f]{64}\b", entry), entry


def test_names_of_files(lock: ModuleType) -> None:
    assert lock.version_of("torch-2.13.0+cpu-cp311-cp311-manylinux_2_28_x86_64.whl") == "2.13.0"
    assert lock.version_of("blake3-1.0.11.tar.gz") == "1.0.11" and lock.normalised("ast_Serialize") == "ast-serialize"
    assert lock.usable("a-1-cp313-cp313-win_amd64.whl") and lock.usable("a-1-py3-none-any.whl") and lock.usable("a-1.tar.gz")
    assert not lock.usable("a-1-cp310-cp310-win_amd64.whl") and not lock.usable("a-1.exe")


def test_a_loose_constraint_is_refused(lock: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "constraints.txt").write_text("numpy>=2\n")
    with pytest.raises(SystemExit, match="no exact version"):
        lock.pins(tmp_path / "constraints.txt")
