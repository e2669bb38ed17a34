"""Filling of empty texels, and inpainting of the unobserved surface."""

from __future__ import annotations

import numpy as np
import trimesh

from gsbake.texturing.atlas import make_atlas
from gsbake.texturing.inpainting import fill_empty_texels, inpaint_surface
from gsbake.texturing.texels import rasterise


def test_gutter_takes_the_nearest_texel_and_the_rest_is_interpolated() -> None:
    covered = np.zeros((64, 64), bool)
    covered[8:20, 8:20] = covered[40:56, 40:56] = True
    image = np.zeros((64, 64, 2), np.float32)
    image[8:20, 8:20] = (0.2, 1.0)
    image[40:56, 40:56] = (0.8, 1.0)
    out = fill_empty_texels(image, covered, 4)
    assert np.allclose(out[4:24, 8:20], (0.2, 1.0), atol=1e-6) and np.allclose(out[36:60, 40:56], (0.8, 1.0), atol=1e-6)
    assert np.array_equal(out[covered], image[covered])
    assert out[..., 0].min() >= 0.2 - 1e-5 and out[..., 0].max() <= 0.8 + 1e-5
    assert np.allclose(out[..., 1], 1, atol=1e-5)  # no texel is left dark


def test_nothing_covered_is_unchanged() -> None:
    image = np.random.default_rng(0).random((8, 8, 3), np.float32)
    assert np.array_equal(fill_empty_texels(image, np.zeros((8, 8), bool), 2), image)


def test_unobserved_surface_is_harmonic() -> None:
    """Between two observed ends of a tube the harmonic function is linear along it."""
    tube = trimesh.creation.cylinder(radius=0.2, height=2, sections=24)
    for _ in range(3):
        tube = tube.subdivide()
    side = np.abs(tube.face_normals[:, 2]) < 0.5
    tube.update_faces(side)
    tube.remove_unreferenced_vertices()
    points, faces = np.asarray(tube.vertices), np.asarray(tube.faces)
    atlas = make_atlas(points, faces, 256)
    texels = rasterise(atlas.uv, atlas.faces, 256)
    z = texels.interpolate(points[atlas.source], atlas.faces)[:, 2]
    observed = np.abs(z) > 0.5
    given = np.where(observed, 0.5 + 0.4 * z, 9).astype(np.float32)[:, None]
    out = inpaint_surface(given, observed, texels, faces, len(points))[:, 0]
    assert np.array_equal(out[observed], given[observed, 0])
    assert np.abs(out - (0.5 + 0.4 * z)).max() < 0.05
    assert np.abs(out - (0.5 + 0.4 * z)).mean() < 0.015


def test_unobserved_component_takes_the_median() -> None:
    two = trimesh.util.concatenate([trimesh.creation.icosphere(2), trimesh.creation.icosphere(2).apply_translation([3, 0, 0])])
    points, faces = np.asarray(two.vertices), np.asarray(two.faces)
    atlas = make_atlas(points, faces, 128)
    texels = rasterise(atlas.uv, atlas.faces, 128)
    observed = texels.interpolate(points[atlas.source], atlas.faces)[:, 0] < 1.5
    given = np.where(observed, 0.3, 0).astype(np.float32)[:, None]
    assert np.allclose(inpaint_surface(given, observed, texels, faces, len(points)), 0.3, atol=1e-6)
