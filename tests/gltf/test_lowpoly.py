"""Low-poly meshes of other programs: formats, nodes, materials, and the frame that they were made in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
import xatlas

from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Similarity
from gsbake.geometry.ply import has_texture_coordinates, read_textured_mesh, write_mesh
from gsbake.gltf.frame import Y_UP
from gsbake.gltf.lowpoly import LowPoly, read_lowpoly

ASSET = Similarity(0.2, Y_UP, np.array([0.0, 0.3, 0.0]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the dense mesh of an L-shaped body without symmetry about its axes."""
    out = tmp_path_factory.mktemp("mesh")
    dense = body().subdivide().subdivide()
    write_mesh(out / "dense.ply", dense.vertices, dense.faces)
    return out


def body() -> trimesh.Trimesh:
    bounds = [[-0.5, -0.2, -0.6], [0.5, 0.3, -0.3]], [[0.1, -0.2, -0.2], [0.5, 0.1, 0.6]]
    return trimesh.util.concatenate([trimesh.creation.box(bounds=box) for box in bounds])


def unwrapped(frame: Similarity) -> trimesh.Trimesh:
    """The body, unwrapped and moved."""
    mesh = body()
    source, faces, uv = xatlas.parametrize(mesh.vertices, mesh.faces)
    return trimesh.Trimesh(frame.apply(mesh.vertices[source]), faces, process=False, visual=trimesh.visual.TextureVisuals(uv=uv))


@pytest.mark.parametrize(
    ("suffix", "frame", "name"),
    [
        (".glb", ASSET, "the frame of asset.glb"),
        (".obj", ASSET, "the frame of asset.glb"),
        (".ply", ASSET.then(Similarity(1.0, Y_UP.T)), "the frame of asset.glb, +Z up"),
        (".glb", Similarity(1.0, Y_UP), "the frame of mesh.ply, +Y up"),
        (".obj", Similarity(), "the frame of mesh.ply"),
        (".ply", Similarity(), "the frame of mesh.ply"),
    ],
)
def test_the_frame_is_found(folder: Path, tmp_path: Path, suffix: str, frame: Similarity, name: str) -> None:
    mine = unwrapped(frame)
    mine.export(tmp_path / f"mine{suffix}")
    found = read_lowpoly(tmp_path / f"mine{suffix}", folder / "dense.ply", ASSET)
    assert found.notes == (f"{len(mine.faces)} triangles in {name}", "their UVs are kept")
    corners = {tuple(np.round(p, 4) + 0.0) for p in found.vertices}
    assert corners == {tuple(np.round(p, 4) + 0.0) for p in body().vertices}
    write_mesh(tmp_path / "mesh.ply", *found.split())
    assert has_texture_coordinates(tmp_path / "mesh.ply") and not has_texture_coordinates(folder / "dense.ply")
    vertices, faces, uv = read_textured_mesh(tmp_path / "mesh.ply")
    assert uv is not None
    made, given = (
        {tuple(sorted(map(tuple, np.round(values[f], 4).tolist()))) for f in triangles}
        for values, triangles in ((uv, faces), (mine.visual.uv, mine.faces))
    )
    assert made == given


def test_pieces_that_are_inside_out_are_turned(folder: Path, tmp_path: Path) -> None:
    """One of two, in the frame of the asset: its triangles are those of the mesh that is right, and keep the UVs of their corners."""
    mine = unwrapped(ASSET)
    mine.export(tmp_path / "mine.obj")
    right = read_lowpoly(tmp_path / "mine.obj", folder / "dense.ply", ASSET)
    second = ASSET.inverse().apply(mine.triangles.mean(1))[:, 2] > -0.25
    assert 0 < second.sum() < len(second)
    mine.faces = np.where(second[:, None], mine.faces[:, ::-1], mine.faces)
    mine.export(tmp_path / "turned.obj")
    found = read_lowpoly(tmp_path / "turned.obj", folder / "dense.ply", ASSET)
    assert found.notes == (*right.notes, f"{second.sum()} of them were inside out and are turned")

    def corners(mesh: LowPoly) -> set[tuple[tuple[float, ...], ...]]:
        rows = np.concatenate([mesh.vertices[mesh.faces], mesh.uv], 2).round(4) + 0.0  # type: ignore[list-item]
        return {min(tuple(map(tuple, np.roll(triangle, k, 0).tolist())) for k in range(3)) for triangle in rows}

    assert corners(found) == corners(right)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
@pytest.mark.parametrize("sections", [8, 12, 24])
@pytest.mark.parametrize("reverse", [False, True])
def test_thin_walls_are_turned_as_a_whole_or_not_at_all(tmp_path: Path, sections: int, suffix: str, reverse: bool) -> None:
    """A tube whose chords lie nearer to the inner wall than to the outer one; triangles of a GLB share no vertices."""
    dense = trimesh.creation.annulus(0.45, 0.5, 0.9, sections=400).subdivide()
    write_mesh(tmp_path / "dense.ply", dense.vertices, dense.faces)
    mine = trimesh.creation.annulus(0.45, 0.5, 0.9, sections=sections)
    assert mine.is_watertight and mine.volume > 0
    if reverse:
        mine.invert()
    if suffix == ".glb":
        mine.unmerge_vertices()
        mine.apply_transform(np.block([[Y_UP, np.zeros((3, 1))], [np.zeros((1, 3)), 1]]))
    mine.export(tmp_path / f"mine{suffix}")
    found = read_lowpoly(tmp_path / f"mine{suffix}", tmp_path / "dense.ply", None)
    assert any("inside out" in note for note in found.notes) == reverse
    assert trimesh.Trimesh(found.vertices, found.faces).volume > 0


def test_an_open_sheet_that_is_inside_out_is_turned(tmp_path: Path) -> None:
    """Half of a ball; beside a thin wall a sheet stays as it is."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    write_mesh(tmp_path / "dense.ply", ball.vertices, ball.faces)
    sheet = trimesh.creation.icosphere(subdivisions=3)
    sheet.update_faces(sheet.triangles_center[:, 2] > 0)
    for reverse in (False, True):
        mine = trimesh.Trimesh(sheet.vertices, sheet.faces[:, ::-1] if reverse else sheet.faces, process=False)
        mine.export(tmp_path / "mine.ply")
        found = read_lowpoly(tmp_path / "mine.ply", tmp_path / "dense.ply", None)
        assert any("inside out" in note for note in found.notes) == reverse
        corner = found.vertices[found.faces]
        assert (np.einsum("nk,nk->n", np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), corner.mean(1)) > 0).all()


def test_nodes_are_placed_and_materials_joined(folder: Path, tmp_path: Path) -> None:
    """Two boxes of one atlas as two nodes of two materials, one of them mirrored by its node."""
    whole = unwrapped(Similarity(1.0, Y_UP))
    scene = trimesh.Scene()
    mirror = np.diag([-1.0, 1, 1, 1])
    for k, part in enumerate(np.array_split(np.arange(len(whole.faces)), 2)):
        piece = whole.submesh([part], append=True)
        material = trimesh.visual.material.PBRMaterial(name=f"m{k}")
        piece.visual = trimesh.visual.TextureVisuals(uv=piece.visual.uv, material=material)
        if k:
            piece.apply_transform(mirror)
        scene.add_geometry(piece, node_name=f"n{k}", transform=mirror if k else np.eye(4))
    scene.export(tmp_path / "mine.glb")
    found = read_lowpoly(tmp_path / "mine.glb", folder / "dense.ply", None)
    assert found.notes[1:] == ("their UVs are kept", "2 materials become one")
    mesh = trimesh.Trimesh(found.vertices, found.faces)
    assert mesh.is_winding_consistent and mesh.volume == pytest.approx(body().volume, rel=1e-3)


def test_without_uvs_it_is_unwrapped(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.obj").write_text(trimesh.exchange.obj.export_obj(body(), include_normals=False))
    found = read_lowpoly(tmp_path / "mine.obj", folder / "dense.ply", None)
    assert found.uv is None and "they have no UVs and are unwrapped" in found.notes
    assert found.split()[2] is None


def test_uvs_on_some_faces_are_refused(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "half.obj"
    points = "".join(f"v {x} {y} 0\nvt {x} {y}\n" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
    path.write_text(f"{points}f 1/1 2/2 3/3\nf 1 3 4\nf -4//1 -2//1 -1//1\n", encoding="utf-8")
    with pytest.raises(BadInputError, match="has no UVs on 2 of its 3 faces; unwrap all of it, or none"):
        read_lowpoly(path, folder / "dense.ply", None)


def test_a_mesh_elsewhere_and_a_damaged_one(folder: Path, tmp_path: Path) -> None:
    unwrapped(Similarity(7.0)).export(tmp_path / "large.glb")
    with pytest.raises(BadInputError, match="large.glb' does not lie on the dense mesh: .* with .Y or .Z up"):
        read_lowpoly(tmp_path / "large.glb", folder / "dense.ply", ASSET)
    (tmp_path / "bad.obj").write_text("v 0 0\nf 1 2 3\n")
    with pytest.raises(BadInputError, match="bad.obj"):
        read_lowpoly(tmp_path / "bad.obj", folder / "dense.ply", ASSET)
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\nf 1 1 2\n")
    with pytest.raises(BadInputError, match="no triangle with an area"):
        read_lowpoly(tmp_path / "flat.obj", folder / "dense.ply", ASSET)
    (tmp_path / "far.obj").write_text("v 0 0 0\nv 1e39 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(BadInputError, match="not finite or beyond"):
        read_lowpoly(tmp_path / "far.obj", folder / "dense.ply", ASSET)


def test_a_stray_vertex_is_refused(folder: Path, tmp_path: Path) -> None:
    mesh = unwrapped(Similarity())
    mesh.vertices[0] = (1e6, 0, 0)
    mesh.export(tmp_path / "mine.ply")
    with pytest.raises(BadInputError, match="vertices far from the object"):
        read_lowpoly(tmp_path / "mine.ply", folder / "dense.ply", None)


def test_uvs_of_corners_in_a_ply_are_kept(folder: Path, tmp_path: Path) -> None:
    """MeshLab's form: a list of UVs at each face, vertices shared across seams."""
    mine = unwrapped(Similarity())
    points, joined = np.unique(np.round(mine.vertices, 5), axis=0, return_inverse=True)
    lines = [
        "ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(mine.faces)}", "property list uchar int vertex_indices", "property list uchar float texcoord", "end_header",
        *(" ".join(map(str, p)) for p in points),
        *(" ".join(map(str, [3, *joined.ravel()[f], 6, *mine.visual.uv[f].ravel()])) for f in mine.faces),
    ]  # fmt: skip
    (tmp_path / "mine.ply").write_text("\n".join(lines) + "\n")
    assert has_texture_coordinates(tmp_path / "mine.ply")
    found = read_lowpoly(tmp_path / "mine.ply", folder / "dense.ply", None)
    assert found.uv is not None and len(found.vertices) == len(points)
    made = {tuple(np.round(corner, 4)) for corner in found.uv.reshape(-1, 2)}
    assert made == {tuple(np.round(corner * (1, -1) + (0, 1), 4)) for corner in mine.visual.uv}
