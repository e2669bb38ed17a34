"""TSDF fusion against analytic shapes: accuracy, pixel centres, hole filling, carving, memory."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.geometry.region import Region
from gsbake.meshing import cleanup as clean
from gsbake.meshing.depth_views import DepthView
from gsbake.meshing.tsdf import SparseTsdf
from tests.meshing.scenes import Shape, box_with_rod, camera_at, cameras_around, cylinder, sphere, torus, trace

CELL = 2 / 72


def views_of(shape: Shape, cameras: list, noise: float = 0.0, masks: bool = True, cosines: bool = True) -> list[DepthView]:
    rng = np.random.default_rng(1)
    out = []
    for camera in cameras:
        depth, _, cosine = trace(shape, camera)
        mask = np.where(depth > 0, 255, 0).astype(np.uint8)
        noisy = np.where(depth > 0, depth + noise * rng.normal(size=depth.shape), 0).astype(np.float32)
        slant = np.maximum(cosine, 0.1)
        out.append(
            DepthView.from_depth(camera, noisy, np.where(cosine > 0.1, slant, 0), slant if cosines else None, mask if masks else None)
        )
    return out


def fuse(views: list[DepthView], cell: float = CELL, close: bool = True, empty_outside: bool = True, region: Region | None = None) -> tuple:
    field = SparseTsdf([-1.1] * 3, [1.1] * 3, cell, 4 * cell, ball=1.05, empty_outside=empty_outside, region=region)
    for view in views:
        field.fuse_coarse(view)
    field.allocate()
    for view in views:
        field.integrate(view)
    return (*field.mesh(close), field)


@pytest.mark.parametrize("shape", [sphere, torus])
def test_exact_depth_reconstructs_the_shape(shape: Shape) -> None:
    vertices, faces, _ = fuse(views_of(shape, cameras_around()))
    off = shape(vertices) / CELL
    assert np.abs(off).mean() < 0.06
    assert abs(off.mean()) < 0.04  # no bias
    found = clean.topology(vertices, faces)
    assert found.watertight and found.components == 1


def test_the_shape_ends_at_the_region_in_a_flat_face() -> None:
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    region = Region(turn @ [-0.8, 0.0, 0.0], np.array([2.0, 3, 3]), turn)
    vertices, faces, _ = fuse(views_of(sphere, cameras_around()), region=region)
    assert region.distance(vertices).max() < 0.1 * CELL and clean.topology(vertices, faces).watertight
    assert ((vertices @ turn)[:, 0] > 0.2 - 0.1 * CELL).sum() > 50  # the cut is closed
    assert np.abs(sphere(vertices[region.distance(vertices) < -2 * CELL])).mean() < 0.06 * CELL


@pytest.mark.slow
def test_blocks_far_from_the_surface_do_not_matter() -> None:
    views = views_of(torus, cameras_around())
    vertices, faces, sparse = fuse(views)
    field = SparseTsdf([-1.1] * 3, [1.1] * 3, CELL, 4 * CELL, ball=1.05)
    for view in views:
        field.fuse_coarse(view)
    field.allocate(all_blocks=True)
    for view in views:
        field.integrate(view)
    assert field.nbytes > 1.5 * sparse.nbytes and sparse.near_share == field.near_share == pytest.approx(sparse.nbytes / field.nbytes)
    all_vertices, all_faces = field.mesh()
    assert len(all_faces) == len(faces) and np.abs(np.sort(all_vertices, 0) - np.sort(vertices, 0)).max() < 0.02 * CELL


def test_noise_averages_out() -> None:
    off = sphere(fuse(views_of(sphere, cameras_around(), noise=0.5 * CELL))[0]) / CELL
    assert np.abs(off).mean() < 0.15
    assert abs(off.mean()) < 0.05


def test_pixel_centres_are_at_one_half() -> None:
    """One camera per side: an error of half a pixel would shift the surface by 0.5 px = 0.6 cells."""
    size = 90
    cameras = [camera_at(3 * np.array(e), str(i), size) for i, e in enumerate([[1, 0, 0.01], [-1, 0, 0.01], [0, 1, 0.01], [0, -1, 0.01]])]
    cameras += cameras_around((60, -60), 2, size)
    vertices, _, _ = fuse(views_of(sphere, cameras))
    normal = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    shift = np.linalg.lstsq(normal, sphere(vertices), rcond=None)[0] / CELL
    assert np.abs(shift).max() < 0.1
    # In each camera's axes the error must not depend on the position in the image.
    for view in views_of(sphere, cameras[:1]):
        one, _, _ = fuse([view], close=False)
        local = one @ view.camera.R.T
        front = np.linalg.norm(local[:, :2], axis=1) < 0.4
        gradients = np.linalg.lstsq(local[front, :2], sphere(one)[front] / CELL, rcond=None)[0]
        assert np.abs(gradients).max() * 0.6 < 0.1


def test_thin_rod_is_kept() -> None:
    """A rod of radius 0.03, about one cell, on a box."""
    vertices, faces, _ = fuse(views_of(box_with_rod, cameras_around(each=8)))
    assert vertices[:, 2].max() > 0.70
    assert clean.topology(*clean.remove_small_components(vertices, faces, 0.02)[:2]).components == 1
    rod = vertices[vertices[:, 2] > 0.2]
    assert np.abs(box_with_rod(rod)).mean() < 0.5 * CELL


def test_unobserved_bottom_is_closed_flat() -> None:
    views = views_of(cylinder, cameras_around((15, 50), 8) + [camera_at(np.array([0.01, 0, 3.0]), "top")])
    vertices, faces, _ = fuse(views)
    assert clean.topology(vertices, faces).watertight
    bottom = vertices[(np.hypot(vertices[:, 0], vertices[:, 1]) < 0.4) & (vertices[:, 2] < 0)]
    assert len(bottom) > 100
    # The visual hull alone would end in a cone 0.12 below the bottom.
    assert np.abs(bottom[:, 2] + 0.45).max() < 0.06
    seen = vertices[vertices[:, 2] > -0.4]
    assert np.abs(cylinder(seen)).mean() < 0.15 * CELL


@pytest.mark.slow
def test_unobserved_bottom_stays_open_without_filling() -> None:
    views = views_of(cylinder, cameras_around((15, 50), 8))
    vertices, faces, _ = fuse(views, close=False)
    below = vertices[(np.hypot(vertices[:, 0], vertices[:, 1]) < 0.35) & (vertices[:, 2] < 0)]
    assert len(below) == 0
    assert clean.topology(vertices, faces).border_edges > 50
    assert np.abs(cylinder(vertices)).max() < 3 * CELL


@pytest.mark.slow
def test_masks_remove_an_outlier_of_one_view() -> None:
    views = views_of(sphere, cameras_around())
    bad = views[0]
    inverse = bad.inverse.copy()
    inverse[65:85, 70:90] = 1 / 2.1  # an outlier in front of the sphere, inside this view's mask
    views[0] = DepthView(bad.camera, inverse, bad.weight, bad.cosine, bad.mask_distance)
    vertices, faces, _ = fuse(views)
    assert np.abs(sphere(vertices)).max() < 2 * CELL
    assert clean.topology(vertices, faces).components == 1


def test_without_masks_the_surface_is_cut_at_the_ball() -> None:
    def room(p: np.ndarray) -> np.ndarray:
        return np.minimum(sphere(p), p[..., 2] + 0.5)  # an infinite table

    views = views_of(room, cameras_around((20, 50), 6), masks=False)
    vertices, faces, _ = fuse(views, empty_outside=False)
    assert np.linalg.norm(vertices, axis=1).max() <= 1.05
    table = vertices[np.linalg.norm(vertices[:, :2], axis=1) > 0.75]
    assert len(table) > 200 and np.abs(table[:, 2] + 0.5).max() < CELL
    assert clean.topology(vertices, faces).border_edges > 50


@pytest.mark.slow
def test_memory_is_proportional_to_the_surface() -> None:
    views = views_of(sphere, cameras_around((10,), 6))
    sizes = [fuse(views, cell)[2].nbytes for cell in (CELL, CELL / 2)]
    assert sizes[1] < 5 * sizes[0]  # a dense volume would grow eightfold
    assert sizes[1] < 0.6 * 9 * (2.2 / (CELL / 2)) ** 3


def test_threads_do_not_change_the_result() -> None:
    import torch

    views = views_of(torus, cameras_around((10, 50), 4), noise=0.3 * CELL)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = fuse(views)
        torch.set_num_threads(2)
        two = fuse(views)
    finally:
        torch.set_num_threads(before)
    np.testing.assert_array_equal(one[0], two[0])
    np.testing.assert_array_equal(one[1], two[1])


def test_wrong_order_and_wrong_size_raise() -> None:
    field = SparseTsdf([-1] * 3, [1] * 3, 0.1, 0.4)
    camera = camera_at(np.array([3.0, 0, 0]), "x")
    with pytest.raises(RuntimeError, match="fuse_coarse"):
        field.integrate(DepthView.from_depth(camera, np.ones((camera.height, camera.width), np.float32)))
    with pytest.raises(ValueError, match="depth"):
        DepthView.from_depth(camera, np.ones((4, 4), np.float32))
