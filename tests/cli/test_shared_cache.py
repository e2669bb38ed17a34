"""`gsbake cache` of a shared store."""

from __future__ import annotations

from pathlib import Path

from tests.cli.conftest import Run


def test_list_check_limit_and_clean_a_shared_store(run: Run, capture: Path, tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    assert run("run", capture, "--out", "one", "--store", shared, "--quiet").code == 0
    assert run("run", capture, "--out", "two", "--store", shared, "--json").json["stages"][1]["status"] == "cached"
    listed = run("cache", "ls", "--store", shared, "--json").json
    assert [entry["stage"] for entry in listed["entries"]] == ["ingest", "mesh", "export", "report"] and listed["quota_bytes"] is None
    assert run("cache", "quota", "5MB", "--store", shared).code == 0
    assert run("cache", "ls", "--store", shared, "--json").json["quota_bytes"] == 5_000_000
    assert "4 outputs" in run("cache", "ls", "--store", shared).out
    assert run("cache", "verify", "--store", shared).code == 0
    blob = next(path for path in (shared / "cas").rglob("*") if path.is_file())
    blob.write_bytes(blob.read_bytes() + b"x")
    damaged = run("cache", "verify", "--store", shared)
    assert damaged.code == 42 and blob.name in damaged.err and not blob.exists()
    assert run("cache", "gc", "--store", shared, "--keep", "0").code == 0
    assert run("cache", "ls", "--store", shared, "--json").json["entries"] == []
    assert run("cache", "gc", "--store", shared, "--older", "1d").code == 2
    assert run("cache", "quota", "5MB").code == 2
    assert len(run("cache", "ls", "--out", "one", "--json").json["entries"]) == 4
    assert run("run", capture, "--out", "three", "--store", "ftp://x/y").code == 2
