"""Every command in the guide, in the concepts and in the README runs: gsbake's over toy stages with the real declarations, page by page."""

from __future__ import annotations

import json
import re
import shlex
import signal
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
import trimesh
import xatlas

from gsbake.cli import main
from tests.docs import toy_stages
from tests.support.cameras import look_at
from tests.support.gltf_files import write_ball

ROOT = Path(__file__).resolve().parents[2]
CONSTRAINTS = (ROOT / "constraints.txt").read_text(encoding="utf-8")
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for path in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    if "```sh" in path.read_text(encoding="utf-8") or "```python\nimport gsbake" in path.read_text(encoding="utf-8")
)
Run = Callable[[list[str]], int]


def commands(text: str) -> list[str]:
    """The lines of a page's `sh` blocks without comments."""
    lines = [line for block in re.findall(r"```sh\n(.*?)```", text, re.S) for line in block.splitlines()]
    return [stripped for line in lines if (stripped := re.sub(r"(^|\s)#.*", "", line).strip())]


def _call(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    """Run `gsbake ARGUMENTS` in this process; the exit code."""
    import gsbake.api
    from gsbake.cli import doctor

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr(gsbake.api, "REGISTRY", toy_stages.REGISTRY)
    monkeypatch.setattr(doctor, "MODULES", {"json": "json"})
    monkeypatch.setattr(doctor, "machine_findings", lambda out: [])  # the memory and disk that are free beside other work
    monkeypatch.setattr("gsbake.capture.masks.weights.install", lambda: "there")
    monkeypatch.setattr(sys, "argv", ["gsbake", *arguments])
    code: Any = 0
    try:
        main()
    except SystemExit as error:
        code = error.code
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return int(code or 0)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the pages assume to be there: photos, masks, an edited mesh, a profile and finished runs."""
    folder = tmp_path_factory.mktemp("pages")
    for number, name in enumerate(("photos/a.jpg", "photos/b.jpg", "photos/c.jpg", "photos/d.jpg", "masks/a.png")):
        (folder / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(folder / name), np.full((48, 64, 3), 40 * number, np.uint8))  # `gsbake check` reads them
    poses = [look_at((3, i, 1)).camera_to_world_opengl().tolist() for i in range(4)]
    frames = [{"file_path": f"photos/{name}.jpg", "transform_matrix": pose} for name, pose in zip("abcd", poses, strict=True)]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 60, "cx": 32, "cy": 24, "w": 64, "h": 48, "frames": frames}))
    (folder / "edited.ply").write_text("ply\n")
    ball = trimesh.creation.icosphere(subdivisions=1)
    source, corners, uv = xatlas.parametrize(ball.vertices, ball.faces)
    unwrapped = trimesh.Trimesh(ball.vertices[source], corners, process=False, visual=trimesh.visual.TextureVisuals(uv=uv))
    unwrapped.export(folder / "lowpoly.glb")
    (folder / "box.json").write_text('{"centre": [0, 0, 0.5], "size": [1, 1, 1]}')
    (folder / "mine.toml").write_text('extends = "relight"\n[mesh]\nfaces = 10000\n')
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(folder)
        assert _call(["run", "photos", "--out", "out/tankard", "--quiet"], monkeypatch) == 0
    for name in ("asset.glb", "before.glb", "after.glb"):
        write_ball(folder / name, (40, 160, 60))
    return folder


@pytest.fixture
def gsbake(prepared: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run `gsbake ARGUMENTS` in the prepared folder and return the exit code. Pages share it, so that equal stages run once."""
    monkeypatch.chdir(prepared)

    def command(arguments: list[str]) -> int:
        code = _call(arguments, monkeypatch)
        capsys.readouterr()
        return code

    return command


def check(line: str, gsbake: Run) -> str | None:
    """Run or look up one command line; what is wrong with it, or None."""
    words = shlex.split(line)
    program, arguments = words[0], words[1:]
    if program == "gsbake":
        if arguments[0] in ("synth", "render", "compare"):  # the pages' sizes take seconds
            arguments = [*arguments, "--views", "3", "--size", "16"]
        code = gsbake(arguments)
        return None if code == 0 else f"exit code {code}"
    if program == "make":
        targets = [word for word in arguments if "=" not in word and not word.startswith("-")]
        text = (ROOT / "Makefile").read_text(encoding="utf-8")
        missing = [target for target in targets if not re.search(rf"(?m)^{re.escape(target)}:", text)]
        return f"no target {missing}" if missing else None
    if program.rpartition("/")[2].startswith("python"):
        if arguments[:1] == ["-m"]:
            return None if find_spec(arguments[1]) else f"no module {arguments[1]}"
        return None if (ROOT / arguments[0]).is_file() else f"no file {arguments[0]}"
    if program == "pip":  # what it installs is this folder, or pinned
        wanted = [word for word in arguments[1:] if not word.startswith(("-", "https://"))]
        unknown = [word for word in wanted if word != "." and not re.search(rf"(?m)^{re.escape(word)}==", CONSTRAINTS)]
        return f"no pin for {unknown}" if arguments[0] != "install" or unknown else None
    return f"'{program}' is not known here"


def test_a_page_does_not_depend_on_free_memory(gsbake: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """`gsbake doctor` reports a busy machine as a fault; the pages' commands are right all the same."""
    full = psutil.virtual_memory()._replace(available=10**8)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: full)
    assert check("gsbake doctor", gsbake) is None


@pytest.mark.parametrize("page", PAGES)
def test_commands_of(page: str, gsbake: Run) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    wrong = {line: problem for line in commands(text) if (problem := check(line, gsbake))}
    assert not wrong
    for block in re.findall(r"```python\n(import gsbake.*?)```", text, re.S):
        exec(block, {})


def test_all_pages_with_commands_are_found() -> None:
    assert {"README.md", "CONTRIBUTING.md", "docs/guide/first-asset.md", "docs/guide/between-stages.md"} <= set(PAGES)
    assert len(commands((ROOT / "docs" / "guide" / "between-stages.md").read_text(encoding="utf-8"))) >= 10


@pytest.mark.parametrize(
    "line",
    [
        "gsbake bakery photos/",
        "gsbake run photos/ --fast",
        "gsbake run photos/ --profile fastest",
        "gsbake run --out out/tankard --set mesh.triangles=3",
        "gsbake explain bakery --out out/tankard",
        "make cake",
        "python -m benchmarks.nothing",
        "rm -r /",
    ],
)
def test_a_command_that_does_not_exist_is_found(line: str, gsbake: Run) -> None:
    assert check(line, gsbake)


def test_synth_takes_the_options_the_pages_give(gsbake: Run) -> None:
    assert check("gsbake synth out/x --views 40 --sise 400", gsbake)
