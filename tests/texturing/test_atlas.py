"""The atlas: exact square, no overlap, no mirroring, padding, uniform texel density."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.ndimage import distance_transform_edt

from gsbake.texturing import atlas as atlas_module
from gsbake.texturing import packing
from gsbake.texturing.atlas import Atlas, _clusters, _detach, islands, make_atlas
from gsbake.texturing.packing import pack
from gsbake.texturing.texels import overlapping, overlapping_faces, rasterise

SIZE = 256


@pytest.fixture(scope="module")
def bumpy() -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    points = np.asarray(mesh.vertices)
    return points * (1 + 0.08 * np.sin(7 * points).prod(1, keepdims=True)), np.asarray(mesh.faces)


@pytest.fixture(scope="module")
def atlas(bumpy: tuple[np.ndarray, np.ndarray]) -> Atlas:
    return make_atlas(*bumpy, SIZE)


def turn(uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Twice the signed areas with v upwards."""
    a, b, c = (np.column_stack([uv[:, 0], 1 - uv[:, 1]]).astype(float)[faces[:, k]] for k in range(3))
    return np.cross(np.pad(b - a, ((0, 0), (0, 1))), np.pad(c - a, ((0, 0), (0, 1))))[:, 2]


def test_faces_keep_their_order_and_corners(bumpy: tuple[np.ndarray, np.ndarray], atlas: Atlas) -> None:
    assert np.array_equal(atlas.source[atlas.faces], bumpy[1])


def test_uvs_fill_the_square_without_mirroring_or_overlap(atlas: Atlas) -> None:
    assert atlas.uv.min() >= 0 and atlas.uv.max() <= 1
    assert (turn(atlas.uv, atlas.faces) > 0).all()
    assert overlapping(atlas.uv, atlas.faces, 2048) == 0
    assert atlas.fill > 0.45


def test_texel_density_is_even(bumpy: tuple[np.ndarray, np.ndarray], atlas: Atlas) -> None:
    corner = bumpy[0][bumpy[1]]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    by_chart = np.bincount(atlas.chart, turn(atlas.uv, atlas.faces)) / np.bincount(atlas.chart, area)
    assert by_chart.max() / by_chart.min() < 1.01


def test_charts_are_padded(atlas: Atlas) -> None:
    texels = rasterise(atlas.uv, atlas.faces, 1024)  # four texels of this image are one of the atlas
    chart = texels.image(np.where(texels.inside, atlas.chart[texels.face], -1), -1)[..., 0]
    for c in range(atlas.charts):
        others = (chart >= 0) & (chart != c)
        if others.any() and (chart == c).any():
            assert distance_transform_edt(~others)[chart == c].min() >= 4 * 2 - 2


def test_atlas_is_deterministic(bumpy: tuple[np.ndarray, np.ndarray], atlas: Atlas) -> None:
    again = make_atlas(*bumpy, SIZE)
    assert np.array_equal(again.uv, atlas.uv) and np.array_equal(again.faces, atlas.faces)


@pytest.mark.parametrize("many", [2000, 10])
def test_packing_keeps_shape_and_handedness(monkeypatch: pytest.MonkeyPatch, many: int) -> None:
    """By outlines, and as boxes on shelves."""
    monkeypatch.setattr(packing, "MANY_CHARTS", many)
    rng = np.random.default_rng(3)
    triangles = rng.uniform(0, 1, (40, 3, 2))
    flip = np.linalg.det(np.stack([triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]], 1)) < 0
    triangles[flip] = triangles[flip][:, [0, 2, 1]]
    faces = np.arange(120).reshape(-1, 3)
    packed = pack(triangles.reshape(-1, 2), faces, np.arange(40), 256, 2)
    out = packed.uv.reshape(-1, 3, 2)
    for k in range(3):
        before = np.linalg.norm(triangles[:, k] - triangles[:, k - 1], axis=1)
        after = np.linalg.norm(out[:, k] - out[:, k - 1], axis=1)
        assert np.allclose(after, packed.scale * before, rtol=1e-9)
    assert (np.linalg.det(np.stack([out[:, 1] - out[:, 0], out[:, 2] - out[:, 0]], 1)) > 0).all()
    assert packed.uv.min() >= 1 - 1e-9 and packed.uv.max() <= 255 + 1e-9
    assert overlapping(packed.uv / 256, faces, 1024) == 0


def pieces(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Separate icosahedra on a sphere."""
    piece = trimesh.creation.icosahedron()
    places = np.random.default_rng(0).normal(size=(count, 3))
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    vertices = (places[:, None] + 0.01 * np.asarray(piece.vertices)).reshape(-1, 3)
    return vertices, (np.arange(count)[:, None, None] * len(piece.vertices) + piece.faces).reshape(-1, 3)


def test_thousands_of_pieces_are_unwrapped_with_less_padding() -> None:
    """Their padding would not fit the texture; what cannot fit with any is one sentence."""
    vertices, faces = pieces(1000)
    found = make_atlas(vertices, faces, 512)
    assert found.charts > packing.MANY_CHARTS and found.charts * 4**2 > 0.25 * 512**2
    assert overlapping(found.uv, found.faces, 2048) == 0 and (turn(found.uv, found.faces) > 0).all()
    assert np.array_equal(found.source[found.faces], faces) and found.fill > 0.15
    with pytest.raises(ValueError, match="charts with 2 texels of padding do not fit a texture of 128 texels; .* join the mesh's pieces"):
        make_atlas(vertices, faces, 128)


def test_clusters_of_large_meshes_are_those_of_their_halves(monkeypatch: pytest.MonkeyPatch) -> None:
    centres = np.random.default_rng(0).random((9000, 3)) * [4, 1, 1]
    whole = _clusters(centres)
    monkeypatch.setattr(atlas_module, "KMEANS_FACES", 5000)
    halves = _clusters(centres)
    assert np.array_equal(np.unique(halves), np.arange(halves.max() + 1)) and abs(int(halves.max()) - int(whole.max())) <= 1
    left, right = (set(halves[side]) for side in (centres[:, 0] < np.median(centres[:, 0]), centres[:, 0] > np.median(centres[:, 0])))
    assert left.isdisjoint(right)


def test_empty_mesh_is_refused() -> None:
    with pytest.raises(ValueError, match="without faces"):
        make_atlas(np.zeros((3, 3)), np.zeros((0, 3), int), SIZE)


def test_folded_charts_are_split() -> None:
    """A strip that winds more than once around a flat ring folds over itself in one chart; the detached faces do not overlap."""
    turns = np.linspace(0, 3 * np.pi, 60)
    inner = np.stack([np.cos(turns), np.sin(turns)], 1)
    uv = np.concatenate([0.5 + 0.2 * inner, 0.5 + 0.4 * inner])
    i = np.arange(59)
    corner = np.stack([np.stack([i, i + 60, i + 1], 1), np.stack([i + 1, i + 60, i + 61], 1)], 1).reshape(-1, 3)  # along the strip
    folded = overlapping_faces(uv, corner, 512)
    assert 30 < folded.sum() < 50  # half a turn of one and a half lies double
    source, apart, again = _detach(np.arange(120), uv, corner, folded, alone=False)
    assert len(np.unique(islands(len(apart), again))) == 2
    assert np.allclose(apart[again], uv[corner]) and np.array_equal(source[again], corner)
    chart = islands(len(apart), again)
    packed = pack(apart, again, chart, 512, 4)
    assert overlapping(packed.uv / 512, again, 512) == 0
