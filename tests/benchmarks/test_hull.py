"""Figures of hulls: a ball whose hull closes it exactly, and one with a lid that carving took away."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from benchmarks.hull import main, measure_folders, measure_hulls, tables
from benchmarks.truth import Surface
from gsbake.capture.hull.visual_hull import Hull
from gsbake.errors import UsageError
from gsbake.geometry.cameras import CameraSet
from tests.support.cameras import look_at

RADIUS, SIZE = 0.6, 160


def ball(radius: float, cells: int = 96) -> Hull:
    cell = 2 / cells
    axis = (np.arange(cells) + 0.5) * cell - 1
    field = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij")), axis=0) - radius
    return Hull(field < 0, np.full(3, -1.0), cell, field.astype(np.float32))


def test_the_surface_of_a_hull_faces_outwards() -> None:
    surface = Surface(*ball(RADIUS).triangles())
    points, faces = surface.sample(500, 0)
    assert np.linalg.norm(points, axis=1) == pytest.approx(RADIUS, abs=0.003)
    assert (surface.normals(faces) * points).sum(1).min() > 0.9 * RADIUS


@pytest.mark.slow
def test_figures_of_a_ball(tmp_path: Path) -> None:
    """The hull is the ball, and what carving is said to have left is 0.06 too small."""
    z, turn = np.linspace(-0.95, 0.95, 30), 2.4 * np.arange(30)
    eyes = 4.0 * np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    cameras = [look_at(eye, size=SIZE, focal=1.7 * SIZE, name=f"{i:02d}") for i, eye in enumerate(eyes)]
    poses, stereo, truth = tmp_path / "poses", tmp_path / "stereo", tmp_path / "gt"
    for folder in (poses / "photos", poses / "masks", stereo, truth):
        folder.mkdir(parents=True)
    CameraSet(tuple(cameras)).save(poses / "cameras.json")
    for camera in cameras:
        rays = camera.rays()
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        middle = rays @ -camera.centre
        mask = camera.centre @ camera.centre - middle**2 < RADIUS**2
        for kind in ("photos", "masks"):
            cv2.imwrite(str(poses / kind / f"{camera.name}.png"), 255 * mask.astype(np.uint8))
    trimesh.creation.icosphere(subdivisions=5, radius=RADIUS).export(truth / "asset.glb")
    to_world = [np.block([[c.R.T @ np.diag([1, -1, -1]), c.centre[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]) for c in cameras]
    names = ", ".join(f'"{c.name}.png"' for c in cameras)
    (truth / "train.json").write_text(f'{{"names": [{names}], "c2w": {[m.tolist() for m in to_world]}}}')
    with pytest.raises(UsageError, match="no visual hull"):
        measure_folders(poses, stereo, tmp_path)
    ball(RADIUS - 0.06).save(stereo / "hull.npz")
    found = measure_folders(poses, stereo, tmp_path)
    diagonal = 2 * RADIUS * np.sqrt(3)
    assert found.hull.chamfer_pct < 0.5
    assert found.carved.accuracy_pct == pytest.approx(100 * 0.06 / diagonal, rel=0.05)
    assert found.shares.sum() == pytest.approx(1) and found.off.max() == 0  # a ball's hull has no air
    assert found.shares[:3].sum() > 0.8  # and is hard
    lines = tables({"ball": found}).splitlines()
    assert lines[2].startswith("| ball | ") and lines[2].count("→") == 3 and lines[-1].count(", ") == len(found.shares)


def test_an_unfinished_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="has no finished stage poses"):
        measure_hulls(tmp_path / "run", tmp_path)
    assert main([str(tmp_path / "run")]) == UsageError.exit_code
    assert "a run and its capture each" in capsys.readouterr().err
