"""Which library decimates: by the setting and by what is installed, known to the cache key; gsbake without pymeshlab."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh

import gsbake.api
from gsbake.api import RunOptions, open_session
from gsbake.errors import UsageError
from gsbake.meshing.decimator_choice import resolve_decimator
from gsbake.pipeline.key import CacheKey
from gsbake.pipeline.settings import defaults, flatten
from gsbake.python_process import python_command, python_environment
from gsbake.stages import REGISTRY
from tests.meshing.scenes import torus
from tests.meshing.test_mesh_stage import capture  # noqa: F401 (a fixture)

PACKAGE = Path(gsbake.api.__file__).parent

#: Runs the mesh stage in a process that cannot import pymeshlab.
WITHOUT_PYMESHLAB = """
import json, sys
from pathlib import Path
sys.modules["pymeshlab"] = None
from gsbake.config.schema import Mesh
from gsbake.meshing.extract import MeshOptions, extract_mesh
root, out = map(Path, sys.argv[1:])
options = MeshOptions(Mesh(faces=2000, max_resolution=80, max_error=0), train_size=120)
print(json.dumps(extract_mesh(root / "poses", root / "refine", out, options, scratch=out.parent)))
"""


def install(monkeypatch: pytest.MonkeyPatch, pymeshlab: bool) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: real(name) if name != "pymeshlab" else object() if pymeshlab else None)


def test_auto_is_what_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, True)
    assert [resolve_decimator(d) for d in ("auto", "pymeshlab", "fast-simplification")] == ["pymeshlab", "pymeshlab", "fast-simplification"]
    install(monkeypatch, False)
    assert [resolve_decimator(d) for d in ("auto", "fast-simplification")] == ["fast-simplification"] * 2
    with pytest.raises(UsageError, match="pymeshlab, which is not installed"):
        resolve_decimator("pymeshlab")


def test_the_cache_key_knows_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.jpg").write_bytes(b"")
    keys = set()
    for pymeshlab in (True, False):
        install(monkeypatch, pymeshlab)
        session = open_session(RunOptions(photos=tmp_path, out=tmp_path / "out"))
        profile = session.engine.request.profile
        values, known = flatten(profile), defaults(type(profile))
        names = [name for name in values if name.startswith("mesh.")]
        key = CacheKey.for_stage(
            REGISTRY.load("mesh"), {n: values[n] for n in names}, {n: known[n] for n in names}, {}, device="cpu", seed=0
        )  # fmt: skip
        assert key.settings["mesh.decimator"] == ("pymeshlab" if pymeshlab else "fast-simplification")
        keys.add(key.digest)
        assert session.profile.profile.mesh.decimator == "auto"  # what is stored is the user's wish
    assert len(keys) == 2


def test_one_module_imports_pymeshlab_when_it_decimates() -> None:
    importing = {p.relative_to(PACKAGE).as_posix() for p in PACKAGE.rglob("*.py") if re.search(r"import pymeshlab", p.read_text())}
    assert importing == {"meshing/decimators.py"}
    code = "import gsbake.meshing.extract, sys; assert 'pymeshlab' not in sys.modules"
    subprocess.run(python_command("-c", code), env=python_environment(), check=True, timeout=120)


@pytest.mark.slow
def test_the_mesh_stage_works_without_pymeshlab(capture: Path, tmp_path: Path) -> None:  # noqa: F811
    """Chamfer distance to the true torus within 3 % of that with pymeshlab."""
    pytest.importorskip("pymeshlab")
    from gsbake.config.schema import Mesh
    from gsbake.meshing.extract import MeshOptions, extract_mesh

    outs = {name: tmp_path / name for name in ("with", "without")}
    for out in outs.values():
        out.mkdir()
    options = MeshOptions(Mesh(faces=2000, max_resolution=80, max_error=0, decimator="pymeshlab"), train_size=120)
    results = extract_mesh(capture / "poses", capture / "refine", outs["with"], options, scratch=tmp_path)
    assert results["decimator"] == "pymeshlab"
    command = python_command("-c", WITHOUT_PYMESHLAB, str(capture), str(outs["without"]))
    done = subprocess.run(command, env=python_environment(), capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout.splitlines()[-1])
    assert results["decimator"] == "fast-simplification" and results["watertight"] and results["faces"] <= 2000
    chamfer = {}
    for name, out in outs.items():
        mesh = trimesh.load(out / "mesh.ply", process=False)
        assert mesh.is_watertight and mesh.is_winding_consistent
        points, _ = trimesh.sample.sample_surface(mesh, 50_000, seed=0)
        chamfer[name] = np.abs(torus(points)).mean()
    assert chamfer["without"] < 1.03 * chamfer["with"]
