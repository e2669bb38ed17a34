"""Image metrics against closed-form values."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsbake.capture.posed_photos import View
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.gltf.frame import read_transforms_json
from gsbake.imaging.metrics import MAX_PSNR, psnr, ssim
from gsbake.imaging.srgb import decode, encode_bytes
from gsbake.report.quality import GREY, compare, exposure_gain, select_views
from gsbake.report.render import RenderedImage
from tests.report.shapes import front_camera

SIZE = 32
CAMERA = front_camera(4, SIZE, 40)


def picture(grey: float, alpha: np.ndarray) -> RenderedImage:
    rgb = np.full((SIZE, SIZE, 3), grey, np.float32)
    return RenderedImage(decode(rgb), alpha.astype(np.float32), rgb, rgb, rgb)


def box(x0: int, x1: int) -> np.ndarray:
    out = np.zeros((SIZE, SIZE))
    out[8:24, x0:x1] = 1
    return out


def view(value: int, mask: np.ndarray | None) -> View:
    return View(CAMERA, np.full((SIZE, SIZE, 3), value, np.uint8), None if mask is None else (255 * mask).astype(np.uint8))


def test_psnr_of_a_constant_error() -> None:
    a = np.full((4, 4, 3), 0.5, np.float32)
    where = np.zeros((4, 4), bool)
    where[0, 0] = True
    b = a.copy()
    b[0, 0] += 0.1
    b[3, 3] = 0  # outside the compared pixels
    assert psnr(a, b, where) == pytest.approx(20, abs=1e-4)
    assert psnr(a, a, where) == MAX_PSNR
    assert psnr(a, b, np.zeros((4, 4), bool)) == 0


def test_ssim_of_uniform_images_has_a_closed_form() -> None:
    # Without variance SSIM is the luminance term (2 ab + c1) / (a² + b² + c1), c1 = .01².
    a, b = np.full((SIZE, SIZE, 3), 0.4, np.float32), np.full((SIZE, SIZE, 3), 0.6, np.float32)
    where = np.ones((SIZE, SIZE), bool)
    assert ssim(a, b, where) == pytest.approx((2 * 0.24 + 1e-4) / (0.16 + 0.36 + 1e-4), abs=1e-5)
    assert ssim(a, a, where) == pytest.approx(1)


def test_identical_images_match_perfectly() -> None:
    found = compare(view(51, box(8, 24)), picture(0.2, box(8, 24)))
    assert found.psnr == MAX_PSNR and found.ssim == pytest.approx(1)
    np.testing.assert_allclose(found.photo[0, 0], GREY)  # the photo's background is masked


def test_missing_and_superfluous_parts_have_the_same_error() -> None:
    # A third of the union is wrong by |0.2 − 0.5|: mean square error .03.
    missing = compare(view(51, box(8, 20)), picture(0.2, box(8, 16)))
    extra = compare(view(51, box(8, 16)), picture(0.2, box(8, 20)))
    assert missing.psnr == pytest.approx(-10 * math.log10(0.09 / 3), abs=1e-3)
    assert extra.psnr == pytest.approx(missing.psnr, abs=1e-3)


def test_the_exposure_of_the_photo_is_given_to_the_render() -> None:
    mask = box(8, 24)
    rng = np.random.default_rng(0)
    linear = rng.uniform(0.05, 0.3, (SIZE, SIZE, 3)).astype(np.float32)
    dark = View(CAMERA, encode_bytes(linear / 3), (255 * mask).astype(np.uint8))
    found = compare(dark, replace(picture(0.2, mask), linear=linear))
    assert found.psnr < 16 and found.exposed_psnr > 45
    same = compare(View(CAMERA, encode_bytes(linear), (255 * mask).astype(np.uint8)), replace(picture(0.2, mask), linear=linear))
    assert same.exposed_psnr >= same.psnr > 45
    assert exposure_gain(np.ones((4, 3), np.float32), np.full((4, 3), 0.5, np.float32)) == 1  # all clipped


def test_partial_coverage_matches_on_both_sides() -> None:
    mask = 0.4 * box(8, 24)
    exact = (255 * mask).astype(np.uint8) / 255
    assert compare(view(51, mask), picture(0.2, exact)).psnr > 90


def test_without_masks_only_the_pixels_of_the_asset_are_compared() -> None:
    found = compare(view(153, None), picture(0.5, box(8, 24)))
    assert found.psnr == pytest.approx(20, abs=1e-3)
    np.testing.assert_allclose(found.photo[0, 0], 0.6, atol=1e-6)  # not composited


def test_asset_cameras_with_shared_and_own_intrinsics(tmp_path: Path) -> None:
    pose = CAMERA.camera_to_world_opengl().tolist()
    body = {
        "fl_x": 40.0, "fl_y": 41.0, "cx": 16.0, "cy": 15.0, "w": 32, "h": 30,
        "frames": [
            {"file_path": "photos/a b.png", "transform_matrix": pose},
            {"file_path": "photos/c.png", "transform_matrix": pose, "fl_x": 50.0, "w": 64},
        ],
    }  # fmt: skip
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(body))
    found = read_transforms_json(path)
    first, second = found
    assert (first.fx, first.fy, first.cy, first.height) == (40, 41, 15, 30)
    assert (second.fx, second.width, second.name) == (50, 64, "photos/c.png")
    np.testing.assert_allclose(second.centre, [0, 0, 4], atol=1e-12)
    np.testing.assert_allclose(second.view_direction, [0, 0, -1], atol=1e-12)
    # The origin projects to the principal point; a point above it in the world projects above it.
    pixels, _ = first.project(np.array([[0, 0, 0], [0, 0.5, 0]]))
    np.testing.assert_allclose(pixels, [[16, 15], [16, 15 - 41 * 0.5 / 4]])


@pytest.mark.parametrize("text", ["{}", "[]", "no json", '{"frames": [{"file_path": "a.png", "transform_matrix": 3}]}'])
def test_asset_cameras_in_another_format(tmp_path: Path, text: str) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(text)
    with pytest.raises(BadInputError, match="nerfstudio"):
        read_transforms_json(path)


def test_chosen_views() -> None:
    assert select_views(24, [4, 12, 20], 4) == ([4, 12, 20], True)
    picks, held = select_views(80, list(range(4, 80, 8)), 4)
    assert held and len(picks) == 4 and set(picks) <= set(range(4, 80, 8)) and picks[0] < 20 and picks[-1] > 60
    picks, held = select_views(10, [], 3)
    assert not held and picks == sorted(set(picks)) and len(picks) == 3 and picks[0] >= 0 and picks[-1] < 10
    assert select_views(2, [], 4) == ([0, 1], False)


def test_camera_round_trip() -> None:
    rotation, translation = Camera.pose_from_opengl(CAMERA.camera_to_world_opengl())
    np.testing.assert_allclose(rotation, CAMERA.R)
    np.testing.assert_allclose(translation, CAMERA.t)
