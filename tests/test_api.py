"""`gsbake.run` on the toy stages of the command line's tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import gsbake
import gsbake.api
from gsbake.errors import BadInputError, UsageError
from tests.cli import toy_bake


@pytest.fixture
def photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(gsbake.api, "REGISTRY", toy_bake.REGISTRY)
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "tankard"
    folder.mkdir()
    for name in "abc":
        (folder / f"{name}.jpg").write_text(name)
    return folder


def test_run_bakes_and_caches(photos: Path) -> None:
    first = gsbake.run(photos, profile="relight", settings={"mesh.faces": 700, "ingest.invert_masks": True})
    assert first.out == Path("out/tankard") and first.files["asset.glb"].read_text() == "glb ply 700"
    assert [state.status for state in first.stages] == ["run"] * 4
    assert first.results("mesh") == {"faces": 700} and first.warnings == ("photo 3 is blurred",)
    again = gsbake.run(out=first.out)  # photos, profile and settings are stored
    assert [state.status for state in again.stages] == ["cached"] * 4
    with pytest.raises(KeyError):
        first.results("train")


def test_run_stops_after_the_stage_that_is_named(photos: Path) -> None:
    assert [state.name for state in gsbake.run(photos, out="o", until="mesh").stages] == ["ingest", "mesh"]


def test_errors_are_single_sentences(photos: Path) -> None:
    with pytest.raises(UsageError, match="holds no run yet"):
        gsbake.run(out="none")
    with pytest.raises(BadInputError, match="nearest is 'mesh.faces'"):
        gsbake.run(photos, settings={"mesh.face": 3})
    with pytest.raises(
        BadInputError, match=r"export\.front names the photo 'd\.jpg', which is none of the photos \(a\.jpg, b\.jpg, c\.jpg\)"
    ):
        gsbake.run(photos, out="front", settings={"export.front": "d.jpg"})
    with pytest.raises(BadInputError, match=r"bake\.white names the photo 'd\.jpg', which is none of the photos"):
        gsbake.run(photos, out="front", settings={"bake.white": ["a.jpg:1,1", "d.jpg:2,2:0.5"]})
    with pytest.raises(BadInputError, match=r"bake\.white names the photo 'a\.jpg', which ingest\.leave_out leaves out"):
        gsbake.run(photos, out="front", settings={"bake.white": ["a.jpg:1,1"], "ingest.leave_out": ["a.jpg"]})
    assert not Path("front").exists()
    with pytest.raises(UsageError, match="The seed must be a whole number from 0"):
        gsbake.run(photos, seed=2**31)


def test_importing_gsbake_imports_no_large_library() -> None:
    code = "import gsbake, sys; sys.exit(len({'torch', 'numpy', 'pydantic', 'gsbake.api'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
