"""The whole refinement on a sphere whose surface was disturbed."""

from __future__ import annotations

import weakref
from dataclasses import replace

import numpy as np
import pytest

from gsbake.errors import InterruptedRun
from gsbake.kernels.threads import configure
from gsbake.monitor import SilentMonitor
from gsbake.shape_refinement.refine import Level, RefinementOptions, pixel_size, refine_shape
from gsbake.shape_refinement.samples import Photo
from gsbake.shape_refinement.targets import contour_targets
from tests.shape_refinement.conftest import Ball, smooth_light

OPTIONS = RefinementOptions(levels=(Level(16, 2, 1.0), Level(24, 3, 0.7)))


def bumps(ball: Ball, height: float) -> np.ndarray:
    """The sphere with smooth bumps of `height` along its normals."""
    wave = np.sin(11 * ball.vertices[:, 0]) * np.sin(9 * ball.vertices[:, 1] + 1) * np.cos(8 * ball.vertices[:, 2])
    return ball.vertices + height * wave[:, None] * ball.normals


def radii(vertices: np.ndarray) -> float:
    return float(np.abs(np.linalg.norm(vertices, axis=1) - 0.5).mean())


def tilt(ball: Ball, vertices: np.ndarray) -> float:
    cosine = (ball.surface.normals(vertices) * vertices).sum(1) / np.linalg.norm(vertices, axis=1)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())


def refined(ball: Ball, vertices: np.ndarray, photos: list[Photo], masks: bool = True, scale: float = 1.0) -> np.ndarray:
    given = [(p.camera, (255 * p.mask).astype(np.uint8)) for p in photos]
    faces, pixel = ball.surface.faces, pixel_size(vertices * scale, [p.camera for p in photos])
    return refine_shape(vertices * scale, faces, lambda blur: photos, (lambda: given) if masks else None, pixel, options=OPTIONS).vertices


@pytest.mark.parametrize(("metal", "texture"), [(1.0, 0.0), (0.7, 0.3), (0.3, 0.7)])
def test_bumps_go(ball: Ball, metal: float, texture: float) -> None:
    """Of a mirror by its reflections, of a glossy ball with texture by parallax too."""
    start = bumps(ball, 0.008)
    found = refined(ball, start, ball.photos(metal, texture))
    assert radii(found) < 0.6 * radii(start)
    assert tilt(ball, found) < 0.6 * tilt(ball, start)


@pytest.mark.parametrize("scale", [1e-8, 1e-3, 1e4])
def test_the_unit_does_not_matter(ball: Ball, scale: float) -> None:
    start, photos = bumps(ball, 0.008), ball.photos(0.7, 0.3)
    moved = [replace(p, camera=replace(p.camera, t=p.camera.t * scale)) for p in photos]
    one, other = refined(ball, start, photos), refined(ball, start, moved, scale=scale) / scale
    assert other == pytest.approx(one, abs=2e-5)


def test_threads_do_not_matter(ball: Ball) -> None:
    start, photos = bumps(ball, 0.008), ball.photos(0.7, 0.3)
    found = []
    for threads in (1, 2, 3):
        configure(threads)
        found.append(refined(ball, start, photos).tobytes())
    configure(2)
    assert len(set(found)) == 1


@pytest.mark.parametrize("case", ["one photo", "no mask", "flat colour", "black", "clipped", "no photo sees it"])
def test_little_evidence_moves_little(ball: Ball, case: str) -> None:
    """Where the photos say nothing, the mesh stays; no step runs away."""
    photos, masks = ball.photos(0.7, 0.3), True
    match case:
        case "one photo":
            photos = photos[:1]
        case "no mask":
            masks, photos = False, [replace(p, mask=np.ones_like(p.mask)) for p in photos]
        case "flat colour":
            photos = [replace(p, rgb=np.full_like(p.rgb, 0.4)) for p in photos]
        case "black" | "clipped":
            photos = [replace(p, rgb=np.full_like(p.rgb, float(case == "clipped"))) for p in photos]
        case "no photo sees it":
            photos = [replace(p, camera=replace(p.camera, R=-p.camera.R, t=-p.camera.t)) for p in photos]
    found = refined(ball, ball.vertices, photos, masks)
    assert np.isfinite(found).all()
    assert np.linalg.norm(found - ball.vertices, axis=1).max() < 0.02
    assert radii(found) < 2e-3


def test_unused_and_degenerate_parts_stay(ball: Ball) -> None:
    """A vertex without a face, a face without area and two that are one: nothing moves that has no normal."""
    extra = np.array([[0.1, 0.2, 0.3], [2.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 0.1, 0.0]])
    count = len(ball.vertices)
    faces = np.concatenate([ball.surface.faces, [[count + 1, count + 2, count + 3]], ball.surface.faces[:1]]).astype(np.int32)
    photos = ball.photos(0.7, 0.3)
    given = [(p.camera, (255 * p.mask).astype(np.uint8)) for p in photos]
    start = np.concatenate([bumps(ball, 0.004), extra])
    found = refine_shape(start, faces, lambda blur: photos, lambda: given, 0.014, options=OPTIONS).vertices
    assert np.isfinite(found).all() and (found[count:] == extra).all()
    assert radii(found[:count]) < 0.8 * radii(bumps(ball, 0.004))


def test_a_thin_wall_keeps_its_sides_apart(ball: Ball) -> None:
    """A shell of two pixels: each side is seen by other photos, and neither passes through the other."""
    inner = ball.vertices * 0.97
    faces = np.concatenate([ball.surface.faces, ball.surface.faces[:, ::-1] + len(inner)]).astype(np.int32)
    photos = ball.photos(0.7, 0.3)
    found = refine_shape(np.concatenate([bumps(ball, 0.004), inner]), faces, lambda blur: photos, None, 0.014, options=OPTIONS).vertices
    outside, inside = (np.linalg.norm(part, axis=1) for part in np.split(found, 2))
    assert (outside - inside).min() > 0.005


def test_too_few_photos_for_reflections_leave_them_out(ball: Ball) -> None:
    """No place is seen by enough photos to tell reflections from colour: normals would get worse by degrees."""
    photos = ball.photos(0.7, 0.3)[:3]
    given = [(p.camera, (255 * p.mask).astype(np.uint8)) for p in photos]
    start = bumps(ball, 0.004)
    found = refine_shape(start, ball.surface.faces, lambda blur: photos, lambda: given, 0.014, options=OPTIONS)
    assert "explained" not in found.figures
    assert tilt(ball, found.vertices) < 1.4 * tilt(ball, start)


def test_contours_after_are_those_of_the_refined_mesh(ball: Ball) -> None:
    photos = ball.photos(0.7, 0.3)
    given = [(p.camera, (255 * p.mask).astype(np.uint8)) for p in photos]
    found = refine_shape(0.98 * ball.vertices, ball.surface.faces, lambda blur: photos, lambda: given, 0.014, options=OPTIONS)
    assert found.figures["contour_before"] == contour_targets(ball.surface, 0.98 * ball.vertices, given, 2)[1]
    assert found.figures["contour_after"] == contour_targets(ball.surface, found.vertices, given, 2)[1]


class _Stopping(SilentMonitor):
    """Stops at the check number `at`."""

    def __init__(self, at: int) -> None:
        self.at = at

    def check_stop(self) -> None:
        self.at -= 1
        if self.at == 0:
            raise InterruptedRun("stop")


@pytest.mark.parametrize("at", [3, 14, 41])  # within the first masks, the second ones, and the first light
def test_a_stop_request_ends_a_step(ball: Ball, at: int) -> None:
    photos = ball.photos(0.7, 0.3)
    given = [(p.camera, (255 * p.mask).astype(np.uint8)) for p in photos]
    steps: list[str] = []
    with pytest.raises(InterruptedRun):
        refine_shape(
            ball.vertices, ball.surface.faces, lambda blur: photos, lambda: given, 0.014, options=OPTIONS, monitor=_Stopping(at),
            on_step=lambda text, vertices: steps.append(text),
        )  # fmt: skip
    assert len(steps) == at // 13


def test_one_blur_of_the_photos_is_in_memory(ball: Ball) -> None:
    loaded: list[weakref.ref[Photo]] = []
    alive: list[int] = []

    def load(blur: float) -> list[Photo]:
        alive.append(sum(photo() is not None for photo in loaded))
        photos = ball.photos(0.7, 0.3)
        loaded.extend(weakref.ref(photo) for photo in photos)
        return photos

    refine_shape(ball.vertices, ball.surface.faces, load, None, 0.014, options=OPTIONS)
    assert alive == [0, 0]


@pytest.mark.parametrize("turns", [False, True])
def test_reflections_of_a_light_that_turns_are_not_followed(ball: Ball, turns: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a turntable the light turns with respect to the object: its reflections would spoil the true shape."""
    photos = []
    for camera in ball.cameras:
        angle = np.arctan2(camera.centre[1], camera.centre[0]) if turns else 0.0
        turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        with monkeypatch.context() as patch:
            patch.setattr("tests.shape_refinement.conftest.smooth_light", lambda way, turn=turn: smooth_light(way @ turn.T))
            photos += replace(ball, cameras=(camera,)).photos(0.7, 0.3)
    pixel = pixel_size(ball.vertices, ball.cameras)
    found = refine_shape(ball.vertices, ball.surface.faces, lambda blur: photos, None, pixel, options=OPTIONS)
    assert ("explained" in found.figures) != turns
    assert (found.figures["predicted"] < 0) == turns
    assert tilt(ball, found.vertices) < 0.5


def test_a_diffuse_surface_has_no_reflections_to_follow(ball: Ball) -> None:
    """Its texture is for the patches."""
    photos = ball.photos(0.0, 1.0)
    pixel = pixel_size(ball.vertices, ball.cameras)
    found = refine_shape(bumps(ball, 0.008), ball.surface.faces, lambda blur: photos, None, pixel, options=OPTIONS)
    assert "explained" not in found.figures and found.figures["predicted"] < 0.05
