"""The wheel: one top-level package with stages and profiles inside, and a bake from an empty folder with nothing but the wheel. The same
package from the source archive, from an editable install, and from a checkout that is only on the path."""

from __future__ import annotations

import json
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
#: Prints where the package, its stages and its profiles are found, here and in a child.
FIND = """
import json, subprocess, gsbake, gsbake.stages.ingest
from importlib.resources import files
from gsbake.python_process import python_command, python_environment
where = [gsbake.__file__, gsbake.stages.ingest.__file__, str(files("gsbake.profiles") / "smoke.toml")]
child = python_command("-c", "import gsbake.stages.ingest as stage, gsbake.profiles; print(stage.STAGE.name)")
print(json.dumps([where, subprocess.check_output(child, env=python_environment(), text=True).strip()]))
"""
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


def test_the_source_archive_gives_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", tmp_path, cwd=ROOT)
    options = ("--no-deps", "--no-build-isolation", "--quiet", "--wheel-dir", tmp_path)
    run(sys.executable, "-m", "pip", "wheel", *options, next(tmp_path.glob("*.tar.gz")), cwd=tmp_path)
    with zipfile.ZipFile(wheel) as one, zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as other:
        assert {name: one.read(name) for name in one.namelist()} == {name: other.read(name) for name in other.namelist()}


Run = Callable[..., str]
Environment = tuple[Path, Path, Run]


@pytest.fixture
def environment(tmp_path: Path) -> Environment:
    """An environment of its own that has the dependencies, from this one, but no gsbake: its Python, the folder of its packages, and a
    function that runs a command in an empty folder."""
    home, work = tmp_path / "environment", tmp_path / "work"
    venv.create(home, with_pip=False)
    work.mkdir()
    python = home / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    clean = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "COV_", "COVERAGE"))}
    packages = Path(run(python, "-c", "import site; print(site.getsitepackages()[-1])", cwd=work, environment=clean).strip())
    # Entries of a .pth file are not searched for further .pth files: the editable install of the checkout stays out.
    (packages / "dependencies.pth").write_text("\n".join(site.getsitepackages()))

    def call(*command: object, **variables: str) -> str:
        return run(*command, cwd=work, environment=clean | variables)

    return python, packages, call


@pytest.fixture
def installed(wheel: Path, environment: Environment) -> Run:
    """Runs a command of the installed wheel in an empty folder."""
    python, packages, call = environment
    run(sys.executable, "-m", "pip", "install", "--no-deps", "--quiet", "--target", packages, wheel, cwd=packages)
    where, stage = json.loads(call(python, "-c", FIND))
    assert stage == "ingest" and all(Path(path).is_relative_to(packages) for path in where)
    return lambda *command: call(python, "-m", "gsbake", *command)


def test_an_editable_install_is_the_checkout(environment: Environment) -> None:
    python, _, call = environment
    call(python, "-m", "pip", "install", "--no-deps", "--no-build-isolation", "--quiet", "--editable", ROOT)
    check_checkout(call(python, "-c", FIND))


def test_a_checkout_on_the_path(environment: Environment) -> None:
    python, _, call = environment
    check_checkout(call(python, "-c", FIND, PYTHONPATH=str(ROOT)))


def check_checkout(found: str) -> None:
    """Python found the folders of this repository."""
    where, stage = json.loads(found)
    assert stage == "ingest"
    assert list(map(Path, where)) == [ROOT / "gsbake/__init__.py", ROOT / "stages/ingest.py", ROOT / "profiles/smoke.toml"]


@pytest.mark.slow
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
