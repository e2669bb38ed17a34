"""Texture coordinates that came with a mesh: kept where one texture can have them, refused in a sentence elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import trimesh
import xatlas

from gsbake.texturing.given_uvs import given_atlas, given_uvs

Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def ball() -> Mesh:
    """Vertices, faces and UVs (origin bottom left) of a ball that xatlas unwrapped."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    source, faces, uv = xatlas.parametrize(mesh.vertices, mesh.faces)
    return mesh.vertices[source], faces.astype(np.int64), uv.astype(np.float64)


def test_seams_are_joined_and_the_uvs_kept(ball: Mesh) -> None:
    vertices, faces, uv = ball
    found = given_uvs(*ball)
    assert found is not None and len(found.vertices) == 162 and found.notes == () and found.faults == ()
    assert trimesh.Trimesh(found.vertices, found.faces).is_watertight
    atlas = given_atlas(found.faces, found.uv, 256)
    assert np.allclose(atlas.uv[atlas.faces], uv[faces] * (1, -1) + (0, 1), atol=1e-6)
    assert np.allclose(found.vertices[atlas.source[atlas.faces]], vertices[faces], atol=1e-6)
    assert len(atlas.uv) == len(uv) and atlas.charts > 1 and 0.3 < atlas.fill < 1


def test_no_uvs_and_uvs_without_area_are_none(ball: Mesh) -> None:
    vertices, faces, uv = ball
    assert given_uvs(vertices, faces, None) is None
    assert given_uvs(vertices, faces, np.full_like(uv, np.nan)) is None
    assert given_uvs(vertices, faces, np.zeros_like(uv)) is None


def test_another_square_and_triangles_without_area(ball: Mesh) -> None:
    vertices, faces, uv = ball
    found = given_uvs(vertices, np.concatenate([faces, faces[:1, [0, 0, 1]]]), uv + (2, 1))
    assert found is not None and len(found.faces) == len(faces)
    assert found.notes == ("1 triangles without area are left out", "UVs moved into the square 0..1 from 1013")
    assert np.allclose(found.uv, uv[faces] * (1, -1) + (0, 1), atol=1e-6)


def half(uv: np.ndarray, change: Callable[[np.ndarray], Any]) -> np.ndarray:
    """UVs of which those on the right are changed."""
    out = uv.copy()
    out[len(uv) // 2 :] = change(out[len(uv) // 2 :])
    return out


@pytest.mark.parametrize(
    ("change", "materials", "words"),
    [
        (lambda uv: np.where(uv[:, :1] > 0.5, np.nan, uv), 1, "has no UVs on"),
        (lambda uv: np.where(uv[:, :1] > 0.5, 1e300, uv), 1, "has no UVs on"),
        (lambda uv: 0.5 * uv + np.where(np.arange(len(uv)) % 2, 0.2, 0.0)[:, None], 1, "more than once"),
        (lambda uv: 0.5 * np.abs(uv - 0.4), 3, "its 3 materials share one square"),
        (lambda uv: 3.5 * uv - 1.2, 1, "for a tiled texture"),
        (lambda uv: half(uv, lambda some: np.full_like(some, 0.5)), 1, "without area on"),
    ],
)
def test_what_one_texture_cannot_have(ball: Mesh, change: Callable[[np.ndarray], Any], materials: int, words: str) -> None:
    vertices, faces, uv = ball
    with pytest.raises(ValueError, match=words):
        given_uvs(vertices, faces, change(uv), materials)


def test_several_tiles_are_named(ball: Mesh) -> None:
    vertices, faces, uv = ball
    two = np.concatenate([vertices, vertices + 3]), np.concatenate([faces, faces + len(vertices)]), np.concatenate([uv, uv + (1, 0)])
    with pytest.raises(ValueError, match=r"in 2 tiles \(1001, 1002\), but the asset has one texture"):
        given_uvs(*two)
    stacked = two[0], two[1], np.concatenate([uv, uv])
    with pytest.raises(ValueError, match="overlapping or stacked UVs"):
        given_uvs(*stacked)
