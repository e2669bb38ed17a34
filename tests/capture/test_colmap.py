"""pycolmap breaks zlib when it is loaded first, and takes over SIGTERM; these tests guard its only import."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("writer", ["cv2.imwrite(path, image)", "PIL.Image.fromarray(image).save(path)", "zlib.compress(image, 9)"])
def test_png_is_written_after_pycolmap(tmp_path: Path, writer: str) -> None:
    """A new process imports pycolmap first and writes a PNG afterwards."""
    code = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
from gsbake.capture.colmap import pycolmap
import zlib, numpy as np, cv2, PIL.Image
image = np.random.default_rng(0).integers(0, 255, (300, 300, 3), np.uint8)
path = {str(tmp_path / "a.png")!r}
for _ in range(3):
    {writer}
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-500:]


def test_zlib_is_imported_first() -> None:
    tree = ast.parse((ROOT / "gsbake/capture/colmap.py").read_text())
    imports = [a.name for node in tree.body if isinstance(node, ast.Import) for a in node.names]
    assert imports.index("zlib") < imports.index("pycolmap")


def test_nothing_else_imports_pycolmap() -> None:
    importers = []
    for path in [p for folder in ("gsbake", "stages") for p in (ROOT / folder).rglob("*.py") if p.name != "colmap.py"]:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(name.split(".")[0] == "pycolmap" for name in names):
                importers.append(path.name)
    assert not importers


@pytest.mark.skipif(sys.platform == "win32", reason="processes are not asked to stop by signals there")
@pytest.mark.parametrize(("handler", "code"), [("signal.signal(signal.SIGTERM, lambda *_: sys.exit(75))", 75), ("pass", -15)])
def test_sigterm_is_left_to_the_stage(handler: str, code: int) -> None:
    """A new process sets a handler or none, imports pycolmap, and sends itself the signal."""
    program = f"""
import os, signal, sys
sys.path.insert(0, {str(ROOT)!r})
{handler}
from gsbake.capture.colmap import pycolmap
os.kill(os.getpid(), signal.SIGTERM)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == code and "stack trace" not in done.stderr
