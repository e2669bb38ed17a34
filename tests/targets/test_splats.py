"""Splats: harmonics and quaternions turn with the frame, and the file has the layout of splat viewers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from gsbake.geometry.cameras import Similarity
from gsbake.gltf.write import GltfMesh
from gsbake.surfels import spherical_harmonics
from gsbake.surfels.model import create
from gsbake.surfels.raster.reference import rotation_matrix
from gsbake.targets.maps import BakedMaps
from gsbake.targets.splats import SH0, basis, rotated_harmonics, rotated_quaternions, write_splats

TURN = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()


def test_the_basis_is_that_of_the_surfels() -> None:
    rng = np.random.default_rng(0)
    sh, d = rng.normal(size=(6, 9, 3)), rng.normal(size=(6, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    expected = spherical_harmonics.twin(torch.from_numpy(sh), torch.from_numpy(d), torch.zeros(3).double()).numpy()
    assert np.allclose(0.5 + np.einsum("nk,nkc->nc", basis(d), sh), expected)


def test_turned_harmonics_have_the_same_colour_from_the_turned_direction() -> None:
    rng = np.random.default_rng(1)
    sh, d = rng.normal(size=(5, 9, 3)), rng.normal(size=(5, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    before = np.einsum("nk,nkc->nc", basis(d), sh)
    after = np.einsum("nk,nkc->nc", basis(d @ TURN.T), rotated_harmonics(sh, TURN))
    assert np.allclose(before, after)


def test_turned_quaternions() -> None:
    quaternion = Rotation.random(4, random_state=0).as_quat()[:, [3, 0, 1, 2]]
    turned = rotation_matrix(torch.from_numpy(rotated_quaternions(TURN, quaternion))).numpy()
    assert np.allclose(turned, TURN @ rotation_matrix(torch.from_numpy(quaternion)).numpy())


def test_the_file_has_the_layout_of_splat_viewers(tmp_path: Path) -> None:
    points = np.array([[0.1, 0.2, 0.3], [0.4, -0.5, 0.6]])
    normals = np.array([[0.0, 0, 1], [0.6, 0, 0.8]])
    surfels = create(points, normals, np.array([0.1, 0.2]), np.array([[0.2, 0.4, 0.6], [0.9, 0.5, 0.1]]), "colour", 1, 0.0, 20.0)
    surfels.save(tmp_path / "s.safetensors")
    frame = Similarity(2.0, TURN, np.array([1.0, 2, 3]))
    assert write_splats(tmp_path / "s.safetensors", tmp_path / "s.ply", frame) == 2
    head, _, body = (tmp_path / "s.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")]
    rest = [f"f_rest_{k}" for k in range(9)]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity", "scale_0", "scale_1", "scale_2",
                     "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    rows = np.frombuffer(body, "<f4").reshape(2, -1)
    column = {name: rows[:, k] for k, name in enumerate(names)}
    assert np.allclose(rows[:, :3], frame.apply(points), atol=1e-6)
    assert np.allclose(rows[:, 3:6], normals @ TURN.T, atol=1e-6)
    assert np.allclose(0.5 + SH0 * rows[0, 6:9], [0.2, 0.4, 0.6], atol=1e-6)
    opacity = surfels.opacity().numpy()
    assert np.allclose(1 / (1 + np.exp(-column["opacity"])), np.minimum(opacity, 1 - 1e-6), atol=1e-5)
    assert np.allclose(np.exp(column["scale_0"]), 2 * 0.6 * np.array([0.1, 0.2]), rtol=1e-5)
    assert np.allclose(np.exp(column["scale_2"] - column["scale_1"]), 0.01, rtol=1e-4)
    turned = rotation_matrix(torch.from_numpy(rows[:, -4:].astype(float))).numpy()
    assert np.allclose(turned[:, :, 2], normals @ TURN.T, atol=1e-6)


def read(path: Path) -> dict[str, np.ndarray]:
    """Columns of a splat file by name."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names))
    return {name: rows[:, k] for k, name in enumerate(names)}


def test_materials_of_surfels_that_carry_them(tmp_path: Path) -> None:
    points, normals = np.array([[0.1, 0.2, 0.3], [0.4, -0.5, 0.6]]), np.array([[0.0, 0, 1], [0.6, 0, 0.8]])
    surfels = create(points, normals, np.array([0.1, 0.2]), np.array([[0.2, 0.4, 0.6], [0.9, 0.5, 0.1]]), "pbr", 1, 0.0, 20.0)
    surfels.attributes["roughness"][:] = torch.logit(torch.tensor([0.3, 0.7]))
    surfels.attributes["metallic"][:] = torch.logit(torch.tensor([0.1, 0.9]))
    surfels.save(tmp_path / "s.safetensors")
    write_splats(tmp_path / "s.safetensors", tmp_path / "s.ply", Similarity())
    column = read(tmp_path / "s.ply")
    assert list(column)[-6:] == ["rot_3", "base_color_0", "base_color_1", "base_color_2", "roughness", "metallic"]
    assert np.allclose(column["roughness"], [0.3, 0.7]) and np.allclose(column["metallic"], [0.1, 0.9])
    assert np.allclose(column["base_color_0"][0], ((0.2 + 0.055) / 1.055) ** 2.4, atol=1e-4)


def test_materials_of_the_bake_at_each_surfel(tmp_path: Path) -> None:
    """A square whose left half is smooth metal, its right half rough."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    up, along = np.tile(np.float32([0, 0, 1]), (4, 1)), np.tile(np.float32([1, 0, 0, 1]), (4, 1))
    mesh = GltfMesh(2 * corners + 1, up, along, corners[:, :2] * (1, -1) + (0, 1), np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    left = (np.arange(64) < 32)[None, :, None]
    orm = np.where(left, np.float32([1, 0.2, 1]), np.float32([1, 0.9, 0])) * np.ones((64, 1, 1), np.float32)
    colour = np.where(left, np.float32([0.9, 0.6, 0.3]), np.float32([0.1, 0.2, 0.3])) * np.ones((64, 1, 1), np.float32)
    points = np.array([[0.2, 0.3, 0.01], [0.8, 0.6, -0.02]])
    create(points, np.array([[0.0, 0, 1]] * 2), np.array([0.1, 0.1]), None, "colour", 1, 0.0, 20.0).save(tmp_path / "s.safetensors")
    frame = Similarity(2.0, translation=np.array([1.0, 1, 1]))
    maps = BakedMaps(mesh, np.asarray(colour, np.float32), np.asarray(orm, np.float32), None, None)
    write_splats(tmp_path / "s.safetensors", tmp_path / "s.ply", frame, maps)
    column = read(tmp_path / "s.ply")
    assert np.allclose(column["roughness"], [0.2, 0.9]) and np.allclose(column["metallic"], [1, 0])
    assert np.allclose(column["base_color_1"], [0.6, 0.2])
    write_splats(tmp_path / "s.safetensors", tmp_path / "s.ply", frame)
    assert "metallic" not in read(tmp_path / "s.ply")
