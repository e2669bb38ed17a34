"""Unseen surface, directions to photograph it from, the map of cameras, and advice."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsbake.geometry.raycast import RayCaster
from gsbake.geometry.region import Region
from gsbake.imaging.exr import write_exr
from gsbake.report.advice import advice
from gsbake.report.coverage import SurfacePoints, in_words, map_json, proposals, surface_points
from gsbake.report.render import Asset
from gsbake.report.sheets import missed_panel
from tests.report.shapes import ball
from tests.support.cameras import look_at


@pytest.fixture(scope="module")
def asset() -> Asset:
    shape = ball(0.7, rows=32)
    return Asset(shape.position, shape.normal.astype(np.float32), None, shape.uv, shape.faces, np.ones((4, 4, 3), np.float32))


def unseen_below(asset: Asset) -> SurfacePoints:
    """Points of the ball, of which those facing down are unseen."""
    k = np.arange(800) + 0.5
    height, turn = 1 - 2 * k / 800, np.pi * (1 + 5**0.5) * k
    normal = np.stack([np.sqrt(1 - height**2) * np.cos(turn), height, np.sqrt(1 - height**2) * np.sin(turn)], 1)
    return SurfacePoints(0.7 * normal, normal, normal[:, 1] > -0.4)


def test_the_bottom_is_photographed_from_below(asset: Asset) -> None:
    found = proposals(unseen_below(asset), RayCaster(asset.position, asset.faces), asset.radius)
    assert found and found[0][0][1] < -0.8 and found[0][1] > 0.6
    assert sum(share for _, share in found) <= 1 + 1e-9
    assert proposals(SurfacePoints(np.zeros((2, 3)), np.zeros((2, 3)), np.ones(2, bool)), RayCaster(asset.position, asset.faces), 1.0) == ()


def test_a_wall_hides_what_is_behind_it(asset: Asset) -> None:
    """A plate below the ball: straight below is no direction to see its bottom from."""
    corners = np.array([[-3.0, -0.75, -3], [3, -0.75, -3], [3, -0.75, 3], [-3, -0.75, 3]])
    count = len(asset.position)
    faces = np.concatenate([asset.faces, np.array([[0, 1, 2], [0, 2, 3]], np.int32) + count])
    found = proposals(unseen_below(asset), RayCaster(np.concatenate([asset.position, corners]), faces), asset.radius)
    assert all(direction[1] > -0.5 for direction, _ in found)


@pytest.mark.parametrize(
    ("direction", "words"),
    [((0, 0, 1), "the front, 0° above the horizon"), ((1, 0, 0), "the right"), ((0, 1, 0), "straight above"),
     ((-0.7, -0.5, -0.5), "the back left, 30° below"), ((0, -1, 0.1), "straight below")],
)  # fmt: skip
def test_directions_in_words(direction: tuple[float, ...], words: str) -> None:
    vector = np.array(direction, float)
    assert words in in_words(vector / np.linalg.norm(vector))


def test_points_are_read_from_the_coverage_of_the_bake(asset: Asset, tmp_path: Path) -> None:
    coverage = np.ones((64, 64, 3), np.float32)
    coverage[40:, :, 1] = 0
    write_exr(tmp_path / "coverage.exr", coverage)
    points = surface_points(asset, tmp_path / "coverage.exr")
    assert points is not None and 0.05 < 1 - points.seen.mean() < 0.95
    assert np.allclose(np.linalg.norm(points.position, axis=1), 0.7, atol=0.02)
    write_exr(tmp_path / "other.exr", 0 * coverage)  # of another atlas
    assert surface_points(asset, tmp_path / "other.exr") is None and surface_points(asset, tmp_path / "none.exr") is None


def test_where_rays_missed_the_dense_mesh_is_shown_in_red(asset: Asset, tmp_path: Path) -> None:
    asset = replace(asset, base_color=np.full((64, 64, 3), 0.4, np.float32))
    coverage = np.ones((64, 64, 4), np.float32)
    write_exr(tmp_path / "coverage.exr", coverage)
    assert missed_panel(asset, tmp_path / "coverage.exr") == ()
    coverage[:16, :, 3] = 0
    write_exr(tmp_path / "coverage.exr", coverage)
    finer = replace(asset, base_color=np.full((256, 256, 3), 0.4, np.float32))
    (panel,) = missed_panel(asset, tmp_path / "coverage.exr")
    assert missed_panel(finer, tmp_path / "coverage.exr") == (panel,)
    assert "25.0% of the texels" in panel.caption
    data = base64.b64decode(panel.image.partition(",")[2])
    shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    red = shown[..., 0] > 2 * shown[..., 1]
    assert red[:14].all() and not red[18:].any()
    assert missed_panel(asset, tmp_path / "none.exr") == ()


def test_the_map_marks_weak_views_and_cannot_leave_its_element(asset: Asset) -> None:
    cameras = [look_at(np.array(c), size=32, name=name) for c, name in (((2, 0, 0), "a"), ((0, 2, 0), "</script>b"), ((1.5, 0, 1.5), "c"))]
    text = map_json(asset, cameras, unseen_below(asset), {"a": 20.0, "</script>b": 30.0}, [(np.array([0.0, -1, 0]), 0.5)])
    body = json.loads(text)
    assert "<" not in text and [c["weak"] for c in body["cameras"]] == [True, False, False]
    assert body["cameras"][2]["psnr"] is None and body["cameras"][1]["name"] == "</script>b"
    assert body["region"] == []
    box = Region(asset.centre, 2 * asset.radius * np.array([1.0, 2, 3]), np.eye(3))
    edges = np.array(json.loads(map_json(asset, cameras, None, {}, [], box))["region"])
    assert edges.shape == (12, 2, 3) and np.allclose(np.abs(edges), [1, 2, 3]) and np.allclose((edges[:, 0] != edges[:, 1]).sum(1), 1)
    assert body["proposed"] == [{"at": [0.0, -2.5, 0.0], "share": 0.5}] and len(body["surface"]) == 800


def test_advice_says_what_to_do_and_from_where() -> None:
    text = advice("bake: 35% of the surface was observed by no photo and is inpainted.", ["the front, 40° below the horizon (60% of it)"])
    assert "Add photos" in text and text.endswith("Best from the front, 40° below the horizon (60% of it).")
    assert advice("bake: 35% of the surface was observed by no photo and is inpainted.").endswith("camera map.")
    assert "--invert-masks" in advice("The visual hull of the masks is empty; check.") and advice("something else") == ""
