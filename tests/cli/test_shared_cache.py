"""`gsbake cache` of a shared store and of an output folder, and folders that are neither."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

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
    assert damaged.code == 42 and blob.name in damaged.err and blob.exists()
    assert run("cache", "gc", "--store", shared, "--keep", "0").code == 0
    assert run("cache", "ls", "--store", shared, "--json").json["entries"] == []
    assert run("cache", "gc", "--store", shared, "--older", "1d").code == 2
    assert run("cache", "quota", "5MB").code == 2
    assert len(run("cache", "ls", "--out", "one", "--json").json["entries"]) == 4
    assert run("run", capture, "--out", "three", "--store", "ftp://x/y").code == 2


def test_a_folder_that_is_no_store_is_refused_before_anything_is_computed(run: Run, capture: Path, tmp_path: Path) -> None:
    home = tmp_path / "home"
    (home / "tmp").mkdir(parents=True)
    (home / "tmp" / "thesis.odt").write_text("mine")
    os.utime(home / "tmp" / "thesis.odt", (1.0, 1.0))
    for words in (
        ("run", capture, "--out", "one"), ("batch", capture, "--out", "many"), ("plan", capture, "--out", "many"),
        ("cache", "ls"), ("cache", "verify"), ("cache", "gc", "--dry-run"), ("cache", "gc", "--keep", "0"), ("cache", "quota", "5MB"),
    ):  # fmt: skip
        end = run(*words, "--store", home)
        assert end.code == 2 and f"'{home}' is not empty and no shared store of gsbake ('tmp/thesis.odt' is in it)" in end.err
        assert end.err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["home", "tankard"]
    assert (home / "tmp" / "thesis.odt").read_text() == "mine" and len(list(home.rglob("*"))) == 2


@pytest.mark.parametrize("project", [None, "{}", '{"name": "mesh tools"}', "{"])
def test_a_folder_that_is_no_output_folder_is_refused(run: Run, tmp_path: Path, project: str | None) -> None:
    keep = tmp_path / "proj" / "stages" / "mesh" / "0123456789abcdef.checkpoint" / "weights"
    keep.parent.mkdir(parents=True)
    keep.write_text("mine")
    if project is not None:
        (tmp_path / "proj" / "project.json").write_text(project)
    for words in (("ls",), ("verify",), ("gc", "--keep", "0"), ("gc", "--dry-run")):
        end = run("cache", *words, "--out", "proj")
        assert end.code == 2 and "is no output folder of gsbake" in end.err and end.err.count("\n") == 1
    assert keep.read_text() == "mine"


def test_links_are_named_and_left_alone(run: Run, capture: Path, tmp_path: Path) -> None:
    assert run("run", capture, "--out", "one", "--quiet").code == 0
    (tmp_path / "one" / "stages").rename(tmp_path / "disk")
    (tmp_path / "one" / "stages").symlink_to(tmp_path / "disk", target_is_directory=True)
    before = sorted((tmp_path / "disk").rglob("*"))
    end = run("cache", "gc", "--out", "one", "--keep", "0")
    assert end.code == 0 and "is a link" in end.err and end.err.count("\n") == 1 and sorted((tmp_path / "disk").rglob("*")) == before


def test_an_output_folder_that_is_named_is_meant(run: Run, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not the store of the environment."""
    monkeypatch.setenv("GSBAKE_STORE", str(tmp_path / "shared"))
    assert run("run", capture, "--out", "one", "--quiet").code == 0
    assert run("cache", "gc", "--out", "one", "--keep", "0").code == 0
    assert run("cache", "ls", "--out", "one", "--json").json["entries"] == []
    assert len(run("cache", "ls", "--json").json["entries"]) == 4
