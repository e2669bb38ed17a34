"""Lights and meshes given on the command line: read in a child, within the memory, and nothing but the file itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import trimesh

from gsbake.errors import BadInputError
from gsbake.geometry import mesh_process
from gsbake.geometry.ply import read_mesh
from gsbake.imaging import image_process
from gsbake.imaging.exr import write_exr, write_hdr
from gsbake.imaging.png import encode_png
from gsbake.viewing.compare import open_surface
from gsbake.viewing.lights import load_light
from tests.support.large_files import png_header, sparse_file

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def test_a_light_with_too_many_pixels_is_refused_by_its_header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsbake.memory_budget.available_memory", lambda: 400_000_000)
    path = tmp_path / "a.exr"
    write_exr(path, np.zeros((2000, 2000, 3), np.float16))
    assert path.stat().st_size < 100_000
    with pytest.raises(BadInputError, match=r"a\.exr' needs 0\.432 GB of memory to be read, and 0\.3 GB may be used") as caught:
        load_light(str(path), tmp_path)
    assert caught.value.exit_code == 42


def test_lights_that_are_none(tmp_path: Path) -> None:
    for content in (b"", b"text", b"#?RADIANCE\n\n-Y 8 +X 8\n"):
        (tmp_path / "a.hdr").write_bytes(content)
        with pytest.raises(BadInputError, match=r"a\.hdr' is not a readable HDR image") as caught:
            load_light(str(tmp_path / "a.hdr"), tmp_path)
        assert "\n" not in str(caught.value)
    spec = oiio.ImageSpec(8, 4, 3, oiio.FLOAT)
    for value in (np.nan, np.inf):
        out = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
        out.open(str(tmp_path / "a.exr"), spec)
        out.write_image(np.full((4, 8, 3), value, np.float32))
        out.close()
        with pytest.raises(BadInputError, match=r"a\.exr' is not a readable HDR image"):
            load_light(str(tmp_path / "a.exr"), tmp_path)


def test_pixels_come_back_as_they_are(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 255, (5, 7, 4), dtype=np.uint8)
    np.testing.assert_array_equal(image_process.read_image(encode_png(pixels), "a"), pixels)
    radiance = np.ldexp(rng.integers(128, 255, (4, 8, 3)) / 256, 1).astype(np.float32)
    write_hdr(tmp_path / "a.hdr", radiance)
    np.testing.assert_allclose(image_process.read_light(tmp_path / "a.hdr"), radiance, rtol=0.01)


def test_a_decoder_that_dies_is_the_images_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    """A child that crashes on the image: one sentence, and the next image gets another child."""
    from gsbake.limited_process import ParserFailedError

    with monkeypatch.context() as patch:

        def crash(*_: object) -> dict[str, Any]:
            raise ParserFailedError("was ended by SIGSEGV")

        patch.setattr(image_process._child, "ask", crash)
        with pytest.raises(BadInputError, match=r"^x\.png cannot be read \(its reader was ended by SIGSEGV\)"):
            image_process.read_image(encode_png(np.zeros((4, 4, 3), np.uint8)), "x.png")
    with pytest.raises(BadInputError, match=r"x\.png cannot be decoded"):
        image_process.read_image(png_header(64, 64), "x.png")
    assert image_process.read_image(encode_png(np.zeros((4, 4, 3), np.uint8)), "x.png").shape == (4, 4, 4)


@pytest.fixture
def child_here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[Path], dict[str, Any]]:
    """The child's code in this process, for the mesh at a path; every file that the reader of meshes opens by itself fails the test."""

    def refuse(_: object, name: object) -> bytes:
        pytest.fail(f"the reader opens {name}")

    monkeypatch.setattr(mesh_process, "limit_memory", lambda _: None)
    monkeypatch.setattr(trimesh.resolvers.FilePathResolver, "get", refuse)
    target = tmp_path / "mesh.npz"
    return lambda path: mesh_process.answer({"path": str(path), "name": path.name, "target": str(target), "needed": 1000})


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl"])
def test_meshes_of_each_format(tmp_path: Path, suffix: str, child_here: Callable[[Path], dict[str, Any]]) -> None:
    path = tmp_path / f"box{suffix}"
    trimesh.creation.box().export(path)
    assert child_here(path) == {}
    with np.load(tmp_path / "mesh.npz") as body:
        assert len(body["faces"]) == 12 and np.ptp(body["vertices"], axis=0) == pytest.approx([1, 1, 1])


def test_a_mesh_comes_back_from_the_child(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(TRIANGLE)
    surface = open_surface(tmp_path / "a.obj")
    assert surface.faces.tolist() == [[0, 1, 2]] and surface.diagonal == pytest.approx(np.sqrt(2))


@pytest.mark.parametrize(("name", "content"), [("a.ply", "text"), ("a.obj", ""), ("a.obj", "f 1 2 3\n"), ("a.stl", "x")])
def test_meshes_that_are_none(tmp_path: Path, name: str, content: str, child_here: Callable[[Path], dict[str, Any]]) -> None:
    (tmp_path / name).write_text(content)
    error = child_here(tmp_path / name)["error"]
    assert error.startswith(name) and "\n" not in error


@pytest.mark.parametrize("name", ["a.3mf", "a.dae", "a.zip", "a"])
def test_formats_that_are_none(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("x")
    with pytest.raises(BadInputError, match=f"{name}' is not a readable mesh; give a GLB, glTF, PLY, OBJ, STL file"):
        open_surface(tmp_path / name)


def test_a_mesh_that_is_larger_than_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsbake.memory_budget.available_memory", lambda: 400_000_000)
    with pytest.raises(BadInputError, match=r"a\.obj' needs 2\.4 GB"):
        open_surface(sparse_file(tmp_path / "a.obj", 100_000_000))


def test_a_mesh_opens_no_other_file(tmp_path: Path, child_here: Callable[[Path], dict[str, Any]]) -> None:
    """Materials of an OBJ and textures of a PLY name files; they stay closed."""
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd secret.png\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nusemtl m\n" + TRIANGLE)
    assert child_here(tmp_path / "a.obj") == {}
    header = "ply\nformat ascii 1.0\ncomment TextureFile secret.png\nelement vertex 3\nproperty float x\nproperty float y\n"
    header += "property float z\nproperty float s\nproperty float t\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(header + "0 0 0 0 0\n1 0 0 0 0\n0 1 0 0 0\n3 0 1 2\n")
    assert child_here(tmp_path / "a.ply") == {}
    assert len(read_mesh(tmp_path / "a.ply")[1]) == 1
