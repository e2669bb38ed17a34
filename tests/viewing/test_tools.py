"""`gsbake inspect`, `compare` and `render` on files of other programs."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from gsbake.cli import main
from gsbake.cli.gates import COMPARED
from gsbake.gltf.scene import open_scene
from gsbake.viewing.lights import load_light
from gsbake.viewing.render import SceneRenderer
from gsbake.viewing.turntable import orbit
from tests.support.gltf_files import two_triangles, write_ball


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Exit code of a command."""
    monkeypatch.setattr(sys, "argv", ["gsbake", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    return int(end.value.code or 0)


def test_compare_measures_a_known_difference(
    ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A ball of another colour and 1 % larger: Chamfer distance .01 of the radius, base colour as of the two colours, normals the same."""
    other = write_ball(tmp_path / "other.glb", (60, 160, 60), radius=1.01)
    options = "--sheet", tmp_path / "sheet.png", "--views", 2, "--size", 96, "--json"
    assert call(monkeypatch, "compare", ball, other, *options) == 0
    figures = json.loads(capsys.readouterr().out)
    diagonal = 2 * np.sqrt(3)
    assert figures["surface"]["chamfer"] == pytest.approx(0.01 / diagonal, rel=0.1)
    assert figures["surface"]["normal_degrees"] < 2
    red = (60 - 40) / 255
    assert figures["images"]["base_color_psnr"] == pytest.approx(-10 * np.log10(red**2 / 3), abs=0.5)
    assert figures["images"]["silhouette_iou"] == pytest.approx(1 / 1.01**2, abs=0.02)
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.size == (3 * 96, 2 * 96)
    assert call(monkeypatch, "compare", ball, ball, "--truth", ball, "--views", 1, "--size", 64, "--json") == 0
    same = json.loads(capsys.readouterr().out)
    assert same["surface"]["chamfer"] < 1e-6 and same["truth"]["surfaces"][0]["chamfer"] < 1e-6


def test_a_figure_worse_than_its_bound_is_an_exit_code(
    ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """More is better for some figures, less for others; every figure can have a bound, and all is printed as without one."""
    other = write_ball(tmp_path / "other.glb", (60, 160, 60), radius=1.01)
    command = ("compare", ball, other, "--truth", ball, "--views", 1, "--size", 64, "--json", "--fail-under")
    assert call(monkeypatch, *command, "base_color_psnr=20,chamfer=0.01,truth.chamfer=0.01") == 0
    end = capsys.readouterr()
    figures = json.loads(end.out)
    assert end.err == "" and figures["exit_code"] == 0
    truth = {f"truth.{key}" for key in figures["truth"]["surfaces"][1]}
    assert set(COMPARED) == {*figures["surface"], *figures["images"], *truth}
    assert call(monkeypatch, *command, "base_color_psnr=40,chamfer=0.01", "--fail-under", "truth.chamfer=0.001") == 3
    end = capsys.readouterr()
    found = json.loads(end.out)
    assert found["exit_code"] == 3 and found["images"] == figures["images"]
    assert end.err.count("\n") == 1 and end.err.endswith(f"{found['error']}\n") and " chamfer" not in end.err
    assert "base_color_psnr is 26" in end.err and "not at least 40; truth.chamfer is 0.00" in end.err and "not at most 0.001." in end.err


@pytest.mark.parametrize("name", ["turn.png", "turn.webp", "turn.mp4"])
def test_turntables(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str) -> None:
    """Four views in each format, read back by another library; the ball is green and in the middle."""
    out = tmp_path / name
    assert call(monkeypatch, "render", ball, "--turntable", out, "--views", 4, "--size", 64, "--samples", 1, "--json") == 0
    assert json.loads(capsys.readouterr().out)["views"] == 4
    if name.endswith("mp4"):
        film = cv2.VideoCapture(str(out))
        assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 4
        picture = film.read()[1][..., ::-1]
    else:
        with Image.open(out) as image:
            assert getattr(image, "n_frames", 1) == (4 if name.endswith("webp") else 1)
            picture = np.asarray(image.convert("RGB"))[:64, :64]
    red, green, blue = picture[32, 32].astype(int)
    assert green > red + 20 and green > blue + 20
    assert not list(tmp_path.glob(".*partial*"))


def test_alpha_lets_what_lies_behind_through(tmp_path: Path) -> None:
    """A half transparent, unlit triangle: coverage .5 in its middle, nothing of a triangle whose alpha is cut off."""
    for mode, expected in (("BLEND", 0.5), ("OPAQUE", 1.0), ("MASK", 0.0)):
        material = {"alphaMode": mode, "alphaCutoff": 0.6, "doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}
        material["pbrMetallicRoughness"] = {"baseColorFactor": [0, 1, 0, 0.5]}
        path = tmp_path / f"{mode}.gltf"
        path.write_text(json.dumps(two_triangles(materials=[material], nodes=[{"mesh": 0}], scenes=[{"nodes": [0]}])))
        renderer = SceneRenderer(open_scene(path))
        camera = orbit(np.array([0.3, 0.3, 0.0]), 0.1, 1, 9, elevation=0.0)[0]
        image = renderer.draw(camera, load_light("studio", tmp_path), 1)
        assert image.alpha[4, 4] == pytest.approx(expected, abs=1e-5)
        if expected:
            np.testing.assert_allclose(image.linear[4, 4], [0, 1, 0], atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["inspect", "missing.glb"], 42, "cannot be read"),
        (["render", "BALL", "--turntable", "x.avi"], 2, "not '.avi'"),
        (["render", "BALL", "--turntable", "x.png", "--light", "moon"], 2, "neither"),
        (["render", "BALL", "--turntable", "x.png", "--light", "hdr"], 2, "no light.hdr"),
        (["compare", "BALL", "README.md"], 42, "README.md"),
        (["compare", "BALL", "BALL", "--fail-under", "psnr=3"], 2, "no figure 'psnr'; choose from chamfer"),
        (["compare", "BALL", "BALL", "--fail-under", "truth.chamfer=1"], 2, "give that with --truth"),
    ],
)
def test_errors_are_one_sentence(
    ball: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    code: int,
    message: str,
) -> None:
    """Wrong files, formats and lights: the documented exit code and a sentence on stderr."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "README.md").write_text("text")
    assert call(monkeypatch, *(ball if a == "BALL" else a for a in arguments)) == code
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error


def test_outputs_replace_no_input_and_no_other_file(
    ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where the output is a link to an input, or an image that is the user's."""
    mine = tmp_path / "asset.png"  # a GLB by its content
    mine.write_bytes(ball.read_bytes())
    (tmp_path / "link.png").symlink_to(mine)
    (tmp_path / "photo.png").write_text("the user's")
    small = ("--views", 1, "--size", 16)
    for sheet, says in ((ball, "written as .png"), (mine, "an input"), (tmp_path / "link.png", "an input")):
        for flags in ((), ("--overwrite",)):
            assert call(monkeypatch, "compare", mine, ball, "--sheet", sheet, *flags, *small) == 2
            assert says in capsys.readouterr().err
            assert call(monkeypatch, "render", mine, "--turntable", sheet, *flags, *small) == 2
            capsys.readouterr()
    assert mine.read_bytes() == ball.read_bytes()
    photo = tmp_path / "photo.png"
    for command in (("compare", ball, ball, "--sheet", photo), ("render", ball, "--turntable", photo)):
        assert call(monkeypatch, *command, *small) == 2
        assert "--overwrite" in capsys.readouterr().err and photo.read_text() == "the user's"
    assert call(monkeypatch, "render", ball, "--turntable", photo, "--overwrite", *small, "--quiet") == 0
    with Image.open(photo) as image:
        assert image.size == (16, 16)
