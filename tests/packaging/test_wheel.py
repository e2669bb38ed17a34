"""The wheel: one top-level package with stages and profiles inside, and a bake from an empty folder with nothing but the wheel."""

from __future__ import annotations

import os
import site
import subprocess
import sys
import venv
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: The smallest bake there is: no stereo, a handful of steps.
TINY = (
    "ingest.max_size=64", "train.iterations=20", "train.max_size=64", "train.init_surfels=500", "refine.iterations=0",
    "mesh.max_resolution=48", "mesh.faces=1000", "bake.size=128", "bake.occlusion_rays=0", "report.views=1", "report.view_size=48",
)  # fmt: skip


def run(*command: object, cwd: Path, environment: Mapping[str, str] | None = None) -> str:
    done = subprocess.run(list(map(str, command)), cwd=cwd, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--quiet", "--wheel-dir", out, ROOT, cwd=out)
    return next(out.glob("*.whl"))


def test_one_top_level_package(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"gsbake"}
    assert {"gsbake/stages/bake.py", "gsbake/profiles/relight.toml", "gsbake/report/page.html.j2", "gsbake/py.typed"} <= set(names)
    assert not [name for name in names if "test" in name or name.endswith((".nbi", ".nbc", ".pyc"))]


Run = Callable[..., str]


@pytest.fixture
def installed(wheel: Path, tmp_path: Path) -> Run:
    """Runs a command in an empty folder, in an environment of its own that has the dependencies, from this one, but no checkout."""
    home, work = tmp_path / "environment", tmp_path / "work"
    venv.create(home, with_pip=False)
    work.mkdir()
    packages = Path(run(home / "bin" / "python", "-c", "import site; print(site.getsitepackages()[0])", cwd=work).strip())
    # Entries of a .pth file are not searched for further .pth files: the editable install of the checkout stays out.
    (packages / "dependencies.pth").write_text("\n".join(site.getsitepackages()))
    run(sys.executable, "-m", "pip", "install", "--no-deps", "--quiet", "--target", packages, wheel, cwd=work)
    clean = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "COV_", "COVERAGE"))}
    where = run(home / "bin" / "python", "-c", "import gsbake; print(gsbake.__file__)", cwd=work, environment=clean).strip()
    assert Path(where).is_relative_to(packages)
    return lambda *command: run(home / "bin" / "python", "-m", "gsbake", *command, cwd=work, environment=clean)


def test_first_stages_from_an_empty_folder(installed: Run, tmp_path: Path) -> None:
    installed("synth", "capture", "--views", 8, "--size", 64)
    assert "relight" in installed("profiles")
    installed("poses", "capture", "--profile", "smoke", "--out", "out")
    assert list((tmp_path / "work" / "out" / "stages" / "poses").glob("*/cameras.json"))


@pytest.mark.slow
def test_it_bakes_from_an_empty_folder(installed: Run, tmp_path: Path) -> None:
    installed("synth", "capture", "--views", 8, "--size", 64)
    text = installed("run", "capture", "--profile", "smoke", "--out", "out", *(word for pair in TINY for word in ("--set", pair)))
    assert (tmp_path / "work" / "out" / "asset.glb").stat().st_size > 10_000 and "Asset" in text
