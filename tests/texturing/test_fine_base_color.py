"""A base colour finer than the other maps: its edge, its detail, and that bands make no difference."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from gsbake.capture.posed_photos import View
from gsbake.geometry.cameras import Camera
from gsbake.imaging.srgb import decode_bytes, encode_bytes
from gsbake.monitor import SILENT
from gsbake.texturing import fine_base_color as module
from gsbake.texturing.atlas import make_atlas
from gsbake.texturing.fine_base_color import fine_base_color
from gsbake.texturing.texels import rasterise
from gsbake.texturing.texture_size import texture_size
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh
from tests.support.cameras import look_at

COARSE, PHOTO = 64, 400
AXES = ((1, 0.2, 0.1), (-1, 0.1, 0.2), (0.1, 1, 0.2), (0.2, -1, 0.1), (0.2, 0.1, 1), (0.1, 0.2, -1))


def colour(p: np.ndarray) -> np.ndarray:
    """Stripes narrower than a coarse texel."""
    return np.repeat(0.4 + 0.2 * np.sin(30 * p.sum(1, keepdims=True)), 3, 1)


@pytest.fixture(scope="module")
def surface() -> UnwrappedMesh:
    ball = trimesh.creation.icosphere(subdivisions=4)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces, np.int64)
    return UnwrappedMesh.of(vertices, faces, make_atlas(vertices, faces, COARSE), COARSE, 2)


def cameras(size: int = PHOTO) -> list[Camera]:
    return [
        look_at(3 * np.array(a) / np.linalg.norm(a), size=size, focal=1.2 * size, name=f"p{k}", up=(0.3, 0.5, 0.8))
        for k, a in enumerate(AXES)
    ]


class Photos:
    """Photos of the striped sphere, as `FullPhotos` has them."""

    def __init__(self) -> None:
        self.cameras = cameras()
        self.posed: Any = SimpleNamespace(cameras=SimpleNamespace(cameras=self.cameras), view=self.view)

    def __len__(self) -> int:
        return len(self.cameras)

    def camera(self, index: int) -> Camera:
        return self.cameras[index]

    def view(self, index: int, max_size: int | None = None) -> View:
        camera = self.cameras[index]
        ray = camera.rays().reshape(-1, 3)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        b = ray @ camera.centre
        root = b * b - (camera.centre @ camera.centre - 1)
        seen = root > 0
        p = camera.centre + (-b - np.sqrt(np.maximum(root, 0)))[:, None] * ray
        rgb = encode_bytes(np.where(seen[:, None], colour(p), 0)).reshape(PHOTO, PHOTO, 3)
        return View(camera, rgb, (seen * 255).astype(np.uint8).reshape(PHOTO, PHOTO))


def refined(surface: UnwrappedMesh, coarse: np.ndarray, size: int = 4 * COARSE, smooth: bool = False) -> np.ndarray:
    photos: Any = Photos()
    return fine_base_color(surface, photos, coarse, size, np.ones((len(AXES), 3), np.float32), 0, smooth, SILENT)


def test_texels_are_as_fine_as_the_photos_pixels(surface: UnwrappedMesh) -> None:
    far, near = (texture_size(cameras(size), surface) for size in (PHOTO, 4 * PHOTO))
    pixel = 2 / (1.2 * PHOTO)  # at the nearest point
    assert far.exact == pytest.approx(surface.texel_size * COARSE / pixel, rel=0.15)
    assert near.size == 4 * far.size and np.log2(far.size) % 1 == 0
    assert texture_size([], surface).size == COARSE
    assert texture_size(cameras(16), surface).size == COARSE
    assert texture_size(cameras(100_000), surface).size == 4096


def test_the_detail_is_the_photos_and_the_colour_that_of_the_coarse_texture(surface: UnwrappedMesh) -> None:
    """The coarse colour is half of the photos', as after a division by their light."""
    size = 4 * COARSE
    coarse = np.full((COARSE, COARSE, 3), 0.2, np.float32)
    image = refined(surface, coarse)
    fine = rasterise(surface.atlas.uv, surface.atlas.faces, size)
    true = 0.5 * colour(fine.interpolate(surface.position, surface.atlas.faces))[:, 0]
    found = image.reshape(-1, 3)[fine.index, 0]
    inner = fine.inside
    assert np.corrcoef(found[inner], true[inner])[0, 1] > 0.9
    assert abs(np.median(found[inner]) - 0.2) < 0.01
    reduced = cv2.resize(image[..., 0], (COARSE, COARSE), interpolation=cv2.INTER_AREA)
    whole = cv2.resize(fine.covered().astype(np.float32), (COARSE, COARSE), interpolation=cv2.INTER_AREA) == 1
    assert np.abs(reduced - 0.2)[whole].mean() < 0.03
    away = image[~cv2.dilate(fine.covered().astype(np.uint8), np.ones((9, 9))).astype(bool)]
    assert (away == decode_bytes(encode_bytes(np.float32([0.2])))).all()
    np.testing.assert_array_equal(image, decode_bytes(encode_bytes(image)))  # nothing that the asset does not hold


def test_a_smooth_factor_keeps_detail_that_the_coarse_texture_blurs() -> None:
    """The coarse texture is half as bright, and less sharp than the mean of the fine one."""
    rng, n = np.random.default_rng(0), 64
    fine = cv2.resize(0.3 + 0.4 * rng.random((n, n)).astype(np.float32), (4 * n, 4 * n), interpolation=cv2.INTER_CUBIC)
    mean = cv2.resize(fine, (n, n), interpolation=cv2.INTER_AREA)
    coarse = np.asarray(0.5 * cv2.GaussianBlur(mean, (0, 0), 0.7), np.float32)
    errors = [np.abs(module._refined(coarse, fine, np.ones(fine.shape, np.bool_), smooth) - 0.5 * fine).mean() for smooth in (False, True)]
    assert errors[1] < 0.5 * errors[0]


def test_bands_of_rows_give_the_same_colour(surface: UnwrappedMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    coarse = np.full((COARSE, COARSE, 3), 0.2, np.float32)
    whole = refined(surface, coarse)
    monkeypatch.setattr(module, "BAND_TEXELS", len(surface.texels) * 4)
    assert np.array_equal(refined(surface, coarse), whole)


def test_memory_grows_with_the_texture_but_not_beyond_a_band(surface: UnwrappedMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    fill = len(surface.texels) / COARSE**2
    assert module.needed_bytes(surface, 256) == pytest.approx(256**2 * (26 + 170 * fill), rel=1e-3)
    monkeypatch.setattr(module, "BAND_TEXELS", 1000)
    assert module.needed_bytes(surface, 256) == 256**2 * 26 + 1000 * 170


def test_rows_of_a_texture_are_those_of_the_whole(surface: UnwrappedMesh) -> None:
    uv, faces = surface.atlas.uv, surface.atlas.faces
    whole = rasterise(uv, faces, 96)
    parts = [rasterise(uv, faces, 96, rows) for rows in ((0, 31), (31, 70), (70, 96))]
    for name in ("index", "face", "inside"):
        assert np.array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name)), name
    assert np.allclose(np.concatenate([p.bary for p in parts]), whole.bary, atol=1e-5)
