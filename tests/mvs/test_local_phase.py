"""Local phase: blind to brightness and contrast; stereo on it finds a weak texture under highlights that move."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from gsbake.mvs.depth_maps import DepthMap, inverse_depth, read_depth
from gsbake.mvs.local_phase import complete, local_phase
from gsbake.mvs.pyramids import Photo, image_pyramid
from tests.mvs.scenes import arc, photo, sphere_depth
from tests.mvs.test_coarse_to_fine import find


def test_brightness_and_contrast_do_not_matter() -> None:
    camera = arc(1)[0]
    seen = photo(camera, sphere_depth(camera))
    bright = replace(seen, grey=(0.5 * seen.grey + 90).round().astype(np.uint8))
    inside = cv2.erode(seen.inside, np.ones((9, 9), np.uint8)) > 0
    phases = [local_phase(one).grey[inside].astype(float) for one in (seen, bright)]
    assert phases[0].std() > 10 and np.corrcoef(phases[0], phases[1])[0, 1] > 0.98 and np.abs(phases[0] - phases[1]).mean() < 3
    # A ramp is all odd, a parabola at its turning point all even.
    x = np.arange(camera.width) - camera.width // 2
    ramp, parabola = (np.broadcast_to(line, seen.grey.shape).astype(np.uint8) for line in (128 + x, np.minimum(40 + x**2 // 2, 250)))
    assert (local_phase(replace(seen, grey=ramp)).grey[5:-5, 5:-5] == 128).all()
    assert local_phase(replace(seen, grey=parabola)).grey[50, camera.width // 2] > 128


def test_weak_texture_under_moving_highlights() -> None:
    """Bands of light that stand in another place in every photo, five times as strong as the texture."""

    def shining(index: int, seen: Photo) -> Photo:
        v, u = np.indices(seen.grey.shape)
        light = 60 * np.sin(0.1 * u + 0.05 * v + 2.1 * index) + 130
        return replace(seen, grey=np.clip(light + (seen.grey - 128.0) / 3, 0, 255).round().astype(np.uint8))

    cameras = arc(5)
    photos = [shining(i, photo(c, sphere_depth(c))) for i, c in enumerate(cameras)]
    truth = sphere_depth(cameras[2])

    def found(images: list[Photo]) -> float:
        """Share of the pixels whose depth is right."""
        planes = find([image_pyramid(one) for one in images], 2)
        depth = 1 / np.maximum(inverse_depth(cameras[2], planes.plane), 1e-6)
        return float(((planes.cost < 0.6) & (np.abs(depth - truth) < 0.01))[truth > 0].mean())

    by_brightness, by_phase = found(photos), found([local_phase(one) for one in photos])
    assert by_phase > max(0.6, 1.5 * by_brightness)


def test_confirmed_depths_stay(tmp_path: Path) -> None:
    camera = arc(1, width=4, height=1)[0]
    maps = [
        DepthMap(camera, np.full((1, 4, 3), plane, np.float32), np.array([sure], np.float32), np.array([views], np.uint8))
        for plane, sure, views in ((1.0, [0.9, 0, 0.2, 0], [5, 0, 2, 0]), (2.0, [0.8, 0.7, 0, 0], [3, 4, 0, 0]))
    ]
    both = complete(*maps)
    np.testing.assert_allclose(both.confidence, [[0.9, 0.7, 0.2, 0]])
    np.testing.assert_array_equal(both.plane[0, :3, 0], [1, 2, 1])
    np.testing.assert_array_equal(both.views, [[5, 4, 2, 0]])
    both.save(tmp_path / "both.npz")
    depth, confidence = read_depth(tmp_path / "both.npz")
    np.testing.assert_array_equal(depth > 0, [[True, False, True, False]])
    np.testing.assert_array_equal(confidence > 0, depth > 0)
