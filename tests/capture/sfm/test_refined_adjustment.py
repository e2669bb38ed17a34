"""Cameras of refined observations: against true ones, and what happens where photos show nothing that can be aligned."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsbake.capture.colmap import pycolmap
from gsbake.capture.poses.colmap_model import camera_of
from gsbake.capture.sfm import refined_adjustment
from gsbake.capture.sfm.refined_adjustment import adjust_refined
from gsbake.capture.sfm.track_refinement import Observations, Refined, refine_observations
from gsbake.geometry.cameras import Camera, Similarity
from tests.capture.test_poses import board_capture

#: Standard deviation in pixels of SIFT's positions.
NOISE = 0.5


def model_of(cameras: list[Camera], rng: np.random.Generator) -> Any:
    """A reconstruction of the board from noisy observations of true points, adjusted to them."""
    model = pycolmap.Reconstruction()
    first = cameras[0]
    lens = pycolmap.Camera(
        camera_id=1, model="SIMPLE_RADIAL", width=first.width, height=first.height, params=[first.fx, first.cx, first.cy, 0.0]
    )
    model.add_camera_with_trivial_rig(lens)
    left = rng.uniform([-0.9, -0.9], [-0.1, 0.9], (200, 2))
    right = rng.uniform([0.1, -0.9], [0.9, 0.9], (200, 2))
    points = np.concatenate([np.column_stack([left, np.zeros(200)]), np.column_stack([right, np.full(200, 0.4)])])
    tracks: list[Any] = [pycolmap.Track() for _ in points]
    for number, camera in enumerate(cameras, 1):
        pixels, depth = camera.project(points)
        seen = np.flatnonzero(camera.in_view(pixels, depth))
        features = [pycolmap.Point2D(xy) for xy in pixels[seen] + rng.normal(0, NOISE, (len(seen), 2))]
        image = pycolmap.Image(name=f"{camera.name}.png", camera_id=1, image_id=number, points2D=features)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(camera.R), camera.t))
        for k, point in enumerate(seen):
            tracks[point].add_element(number, k)
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(point, track)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    pycolmap.bundle_adjustment(model, options)
    return model


def position_error(model: Any, true: list[Camera]) -> float:
    """Root mean square distance of the camera centres from the true ones after the best similarity, in units of half the board."""
    found = np.stack([camera_of(model.images[k], "", "").centre for k in sorted(model.images)])
    centres = np.stack([camera.centre for camera in true])
    return float(np.sqrt(((Similarity.between(found, centres).apply(found) - centres) ** 2).sum(1).mean()))


def test_cameras_come_nearer_to_the_true_ones(tmp_path: Path) -> None:
    true = board_capture(tmp_path)
    model = model_of(true, np.random.default_rng(0))
    adjusted = adjust_refined(model, tmp_path / "images", 1600, lambda done, total: None)
    figures = adjusted.figures
    assert figures["used"] and figures["refined_share"] > 0.8 and figures["decision"][0].endswith("lenses")
    assert figures["refined_px"][1] < 0.8 * figures["refined_px"][0]
    assert position_error(adjusted.model, true) < 0.4 * position_error(model, true)


@pytest.mark.parametrize("detected_size", [1600, 160])
def test_observations_lie_where_the_first_photo_of_a_track_has_them(tmp_path: Path, detected_size: int) -> None:
    """Also where features were detected in photos of half the size."""
    true = board_capture(tmp_path)
    model = model_of(true, np.random.default_rng(1))
    observed = Observations.of(model)
    ticks: list[tuple[int, int]] = []
    refined = refine_observations(model, observed, tmp_path / "images", detected_size, lambda done, total: ticks.append((done, total)))

    def spread(xy: Any) -> float:
        """Median distance in pixels of observations from the mean of their track, carried by true rays to the board and back."""
        errors = []
        for track in range(0, len(observed.points), 5):
            rows = np.flatnonzero((observed.track == track) & refined.refined)
            if len(rows) < 3:
                continue
            cameras = [true[int(p)] for p in observed.photo[rows]]
            depth = 0.0 if observed.points[track][0] < 0 else 0.4
            hits = []
            for camera, (x, y) in zip(cameras, xy[rows], strict=True):
                ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1]) @ camera.R
                hits.append(camera.centre + (depth - camera.centre[2]) / ray[2] * ray)
            mean = np.mean(hits, 0)
            errors += [float(np.linalg.norm(c.project(mean[None])[0][0] - at)) for c, at in zip(cameras, xy[rows], strict=True)]
        return float(np.median(errors))

    assert spread(refined.xy) < 0.1 < 0.4 < spread(observed.xy)
    assert np.linalg.norm(refined.xy - observed.xy, axis=1).max() <= 4 * max(1, 320 / detected_size)
    assert ticks[-1][0] == ticks[-1][1] and all(a[0] < b[0] for a, b in zip(ticks, ticks[1:], strict=False))


def test_cameras_that_do_not_explain_tracks_better_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Positions that an alignment has moved at random, as it would in photos of something that moves."""
    true = board_capture(tmp_path)
    rng = np.random.default_rng(3)
    model = model_of(true, rng)
    observed = Observations.of(model)
    moved = Refined(observed.xy + rng.normal(0, 2, observed.xy.shape), np.ones(len(observed.xy), np.bool_))
    monkeypatch.setattr(refined_adjustment, "refine_observations", lambda *arguments: moved)
    adjusted = adjust_refined(model, tmp_path / "images", 1600, lambda done, total: None)
    assert adjusted.model is model and not adjusted.figures["used"] and adjusted.figures["left_out_tracks"] >= 30
    assert adjusted.figures["decision"][0] == "not used" and "tracks left out" in adjusted.figures["decision"][1]


def test_photos_that_show_nothing_change_nothing(tmp_path: Path) -> None:
    true = board_capture(tmp_path)
    rng = np.random.default_rng(2)
    for path in (tmp_path / "images").iterdir():
        Image.fromarray(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8)).save(path)
    model = model_of(true, rng)
    adjusted = adjust_refined(model, tmp_path / "images", 1600, lambda done, total: None)
    assert adjusted.model is model and not adjusted.figures["used"] and adjusted.figures["refined_share"] < 0.1
    assert adjusted.figures["decision"][0] == "not used"
