"""Projection and fusion against a sphere with an analytic texture."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.monitor import SILENT, Rule
from gsbake.texturing.photo_projection import _exposure_gains
from gsbake.texturing.projection import ProjectionBlender, edge_weights, mask_weights
from gsbake.texturing.view_fusion import solve_gains
from tests.support.cameras import look_at

SIZE = 160


def texture(p: np.ndarray) -> np.ndarray:
    return 0.35 + 0.15 * np.sin(np.stack([5 * p[:, 0], 4 * p[:, 1] + 1, 6 * p[:, 2]], 1))


def camera(direction: np.ndarray, name: str = "view") -> Camera:
    """A camera three units from the origin, looking at it."""
    return look_at(3 * direction / np.linalg.norm(direction), size=SIZE, focal=200, name=name, up=(0.1, 0.2, 1.0))


def photo(view: Camera, highlight: float = 0.0, gain: float = 1.0) -> np.ndarray:
    """A photo of the unit sphere: texture, a highlight that depends on the view, times an exposure gain; blue background."""
    ray = view.rays().reshape(-1, 3)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    b = ray @ view.centre
    root = b * b - (view.centre @ view.centre - 1)
    p = view.centre + (-b - np.sqrt(np.maximum(root, 0)))[:, None] * ray
    colour = texture(p)
    half = view.centre / np.linalg.norm(view.centre) + [0.3, 0, 0.2]
    colour = colour + highlight * (p @ (half / np.linalg.norm(half)) > 0.985)[:, None]
    colour = np.where(root[:, None] > 0, gain * colour, [0.0, 0.0, 1.0])
    return np.clip(colour, 0, 1).reshape(SIZE, SIZE, 3).astype(np.float32)


@pytest.fixture(scope="module")
def sphere() -> RayCaster:
    ball = trimesh.creation.icosphere(subdivisions=5)
    return RayCaster(ball.vertices, ball.faces)


def directions(n: int) -> np.ndarray:
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, np.pi * (1 + 5**0.5) * k
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)


def points(n: int = 3000) -> np.ndarray:
    return directions(n)


def test_highlights_and_exposure_gains_are_removed(sphere: RayCaster) -> None:
    p = points()
    blender = ProjectionBlender(p, p, sphere, 3, 0.02)
    gains = np.exp(np.random.default_rng(0).normal(0, 0.1, 30))
    gains /= np.exp(np.log(gains).mean())
    for d, gain in zip(directions(30), gains, strict=True):
        blender.add(camera(d), photo(camera(d), highlight=0.5, gain=gain))
    logs, view, _ = blender.log_samples()
    solved = blender.result(solve_gains(logs, view, 30))
    assert solved.observed.all()
    assert np.abs(np.log(solved.gains[:, 0] / gains)).max() < 0.02
    error = np.abs(solved.values - texture(p)).max(1)
    assert np.median(error) < 0.004 and np.quantile(error, 0.98) < 0.015
    plain = blender.result()
    assert np.median(np.abs(plain.values - texture(p)).max(1)) > 0.01


def gains_of(sphere: RayCaster, exposures: np.ndarray, written: np.ndarray | None, rule: Rule) -> np.ndarray | None:
    """The gains that are divided out of photos of a sphere with these `exposures` (photos,), `written` in EXIF."""
    p, cameras = points(), [camera(d) for d in directions(len(exposures))]
    blender, surface = ProjectionBlender(p, p, sphere, 3, 0.02), SimpleNamespace(texel_position=p, texel_normal=p)
    for view, exposure in zip(cameras, exposures, strict=True):
        blender.add(view, photo(view, gain=exposure))
    return _exposure_gains(blender, surface, cameras, None if written is None else np.log(written), None, rule, SILENT)


@pytest.mark.parametrize("rule", ["auto", "keep"])
def test_exposures_by_exif_are_divided_out_and_others_solved(sphere: RayCaster, rule: Rule) -> None:
    exposures = np.exp(np.random.default_rng(2).uniform(-0.4, 0.4, 20))
    exposures /= np.exp(np.log(exposures).mean())
    written, solved = gains_of(sphere, exposures, exposures, rule), gains_of(sphere, exposures, None, rule)
    assert written is not None and written == pytest.approx(np.tile(exposures[:, None], 3), rel=1e-6)
    assert solved is not None and solved == pytest.approx(np.tile(exposures[:, None], 3), rel=0.1)
    # edited since: what EXIF has is not in the photos
    assert gains_of(sphere, exposures, exposures[::-1], rule) == pytest.approx(solved)


@pytest.mark.parametrize("count", [1, 2, 19])
@pytest.mark.parametrize("written", [True, False])
def test_few_photos_have_one_exposure_unless_they_are_to_be_equalised(sphere: RayCaster, count: int, written: bool) -> None:
    equal, exposures = np.ones(count), np.linspace(0.7, 1.3, count)
    assert gains_of(sphere, exposures, equal if written else None, "auto") is None
    kept = gains_of(sphere, exposures, equal if written else None, "keep")
    assert kept is not None and (np.ptp(kept) > 0.2) == (count == 19)


def test_what_is_clipped_in_bright_photos_is_a_lower_bound(sphere: RayCaster) -> None:
    """Most photos are four times as bright and clipped: the few others tell the colour."""
    p = points()
    blender = ProjectionBlender(p, p, sphere, 3, 0.02)
    gains = np.where(np.arange(40) % 4 == 0, 1.0, 4.0)[:, None] * np.ones(3)
    for d, gain in zip(directions(40), gains[:, 0], strict=True):
        blender.add(camera(d), photo(camera(d), gain=gain))
    found = blender.result(gains.astype(np.float32))
    dark = np.array([d @ p.T > 0.6 for d, gain in zip(directions(40), gains[:, 0], strict=True) if gain == 1]).any(0)
    clipped = dark & (texture(p) > 0.3).all(1)
    assert clipped.sum() > 300 and np.quantile(np.abs(found.values - texture(p))[clipped], 0.95) < 0.01


def test_background_never_reaches_the_surface(sphere: RayCaster) -> None:
    """Even with pose errors, so that some boundary pixels show the background."""
    p = points()
    blender = ProjectionBlender(p, p, sphere, 3, 0.02)
    rng = np.random.default_rng(1)
    for d in directions(30):
        blender.add(camera(d + rng.normal(0, 0.01, 3)), photo(camera(d)))
    assert np.quantile(blender.result().values[:, 2], 0.999) < 0.6


def test_only_visible_texels_are_observed(sphere: RayCaster) -> None:
    p = points()
    blender = ProjectionBlender(p, p, sphere, 3, 0.02)
    d = np.array([0.0, 1.0, 0.0])
    blender.add(camera(d), photo(camera(d)))
    observed = blender.result().observed
    assert observed[p[:, 1] > 0.6].all()
    assert not observed[p[:, 1] < 1 / 3 - 0.02].any()  # the horizon of a camera at three radii


def test_occluded_texels_are_not_observed(sphere: RayCaster) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    ball.apply_translation([0, 1.5, 0])
    both = trimesh.util.concatenate([trimesh.Trimesh(sphere.vertices, sphere.faces), ball])
    p = points()
    blender = ProjectionBlender(p, p, RayCaster(both.vertices, both.faces), 3, 0.02)
    d = np.array([0.0, 1.0, 0.0])
    blender.add(camera(d), photo(camera(d)))
    observed = blender.result().observed
    # The ball of radius 0.3 at distance 1.5 shades a cone of tan = 0.3 / sqrt(1.5² - 0.3²).
    off = np.hypot(p[:, 0], p[:, 2]) / (3 - p[:, 1])
    slope = 0.3 / np.sqrt(1.5**2 - 0.3**2)
    front = p[:, 1] > 0.6
    assert not observed[front & (off < slope - 0.02)].any() and observed[front & (off > slope + 0.03)].all()


def test_masked_pixels_are_never_used(sphere: RayCaster) -> None:
    p = points()
    blender = ProjectionBlender(p, p, sphere, 3, 0.02)
    d = np.array([0.0, 1.0, 0.0])
    mask = np.full((SIZE, SIZE), 255, np.uint8)
    mask[:, : SIZE // 2] = 0
    blender.add(camera(d), photo(camera(d)), mask_weights(mask, 2))
    pixels, _ = camera(d).project(p)
    observed = blender.result().observed
    assert not observed[pixels[:, 0] < SIZE / 2 - 1].any()
    assert observed[(pixels[:, 0] > SIZE / 2 + 1) & (p[:, 1] > 0.6)].all()


def test_fine_photos_are_antialiased(sphere: RayCaster) -> None:
    """A photo of single-pixel checks must come out grey on a coarse texture, not as moiré."""
    p = points(500)
    blender = ProjectionBlender(p, p, sphere, 1, 0.2)
    checks = np.indices((SIZE, SIZE)).sum(0) % 2
    d = np.array([0.0, 1.0, 0.0])
    blender.add(camera(d), checks[..., None].astype(np.float32))
    blended = blender.result()
    assert np.abs(blended.values[blended.observed] - 0.5).max() < 0.1


def test_depth_edges_have_small_positive_weight() -> None:
    depth = np.zeros((20, 40), np.float32)
    depth[5:15, 5:35] = 2
    weight = edge_weights(depth, 0.1, 4)
    assert weight[10, 20] == 1 and 0 < weight[5, 20] < 0.01 and weight[6, 20] < weight[8, 20]
