"""Writer of the built-in capture: photos and poses as user input, and ground truth in `truth/`.

Poses are NeRF's `transforms.json` (OpenGL camera-to-world, Z-up world). The principal point lies off the image centre and the cameras roll
slightly, to reveal wrong conventions. No stage reads `truth/`; tests and benchmarks do.
"""

from __future__ import annotations

import json
import math
import shutil
import uuid
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.errors import UsageError
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.imaging.srgb import encode_bytes
from gsbake.synth import scene
from gsbake.synth.folder import TRUTH_IMAGES, replace_capture, require_capture_folder, unfinished_folders
from gsbake.synth.shade import LightRig, render, studio_rig

Array = NDArray[np.float64]


def look_at(name: str, centre: Array, target: Array, roll: float, focal: float, principal: tuple[float, float], size: int) -> Camera:
    """Square pinhole camera at `centre` (world, Z-up) that looks at `target`, rotated by `roll` radians around its optical axis."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    rotation = np.stack([math.cos(roll) * right + math.sin(roll) * down, math.cos(roll) * down - math.sin(roll) * right, forward])
    return Camera(name, size, size, focal, focal, principal[0], principal[1], rotation, -rotation @ centre)


def cameras(views: int, size: int, seed: int, background: bool = False) -> tuple[Camera, ...]:
    """Cameras around the object, from below it (with a background: from above the ground) to high above, with jitter by `seed`."""
    draw = np.random.default_rng(seed)
    low, high = (12.0, 70.0) if background else (-28.0, 72.0)
    start = draw.uniform(0, 2 * np.pi)
    out = []
    for i in range(views):
        # Uniform in sin(elevation) is uniform in area; an irrational stride distributes every subset of each n-th photo over the heights.
        t = (i * math.sqrt(2) + 0.5 / views) % 1.0
        height = math.sin(math.radians(low)) * (1 - t) + math.sin(math.radians(high)) * t
        azimuth = start + 2 * np.pi * i / views + draw.normal(0, 0.05)
        horizontal = math.sqrt(1 - height * height)
        distance = draw.uniform(2.3, 2.6)
        target = np.array(scene.CENTRE) + draw.normal(0, 0.015, 3)
        centre = target + distance * np.array([horizontal * math.cos(azimuth), horizontal * math.sin(azimuth), height])
        out.append(look_at(f"{i:03d}", centre, target, draw.normal(0, 0.06), 1.65 * size, (0.51 * size, 0.485 * size), size))
    return tuple(out)


def true_mesh(cells: int = 112) -> tuple[Array, NDArray[np.int64]]:
    """Ground-truth mesh: vertices (v, 3) on the zero set (world) and outward faces (f, 3); `cells` along the bounding sphere's diameter."""
    from skimage.measure import marching_cubes

    cell = 2 * scene.RADIUS / cells
    low = np.array(scene.CENTRE) - scene.RADIUS
    field = scene.grid_distances(low, cell, cells + 1, cells + 1, cells + 1)
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(cell, cell, cell), gradient_direction="descent")
    points = vertices.astype(np.float64) + low
    for _ in range(3):  # project onto the zero set; steps are exact where the field is a distance
        points -= scene.distances(points)[:, None] * scene.normals(points)
    return points, faces.astype(np.int64)


def surface_points(vertices: Array, faces: NDArray[np.int64], count: int, seed: int) -> dict[str, NDArray[np.float32]]:
    """`count` area-uniform surface points (world): position, normal, albedo (linear), roughness, metallic, emission (linear)."""
    draw = np.random.default_rng(seed)
    corner = vertices[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    face = draw.choice(len(faces), count, p=area / area.sum())
    u, v = np.sqrt(draw.random(count)), draw.random(count)
    bary = np.stack([1 - u, u * (1 - v), u * v], 1)
    points = np.einsum("nk,nkc->nc", bary, corner[face])
    points -= scene.distances(points)[:, None] * scene.normals(points)
    surface = scene.materials(points)
    arrays = {
        "position": points,
        "normal": scene.normals(points),
        "albedo": surface[:, :3],
        "roughness": surface[:, 3],
        "metallic": surface[:, 4],
        "emission": scene.emissions(points),
    }
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def _write_png(path: Path, rgb: NDArray[np.uint8], alpha: NDArray[np.uint8] | None = None) -> None:
    channels = [rgb[..., 2], rgb[..., 1], rgb[..., 0]] if rgb.ndim == 3 else [rgb]
    image = np.stack([*channels, alpha] if alpha is not None else channels, -1)
    if not cv2.imwrite(str(path), image):
        raise OSError(f"{path} cannot be written")


def _write_view(folder: Path, camera: Camera, rig: LightRig, background: bool, marker: NDArray[np.uint8]) -> None:
    """Render one camera and write its photo and its ground-truth maps."""
    image, buffers = render(
        camera.R, camera.centre, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, rig, background, marker
    )  # fmt: skip
    coverage = image[..., 3]
    alpha = np.round(255 * coverage).astype(np.uint8)
    to_straight = 1 / np.maximum(coverage, 1e-9)[..., None]
    name = f"{camera.name}.png"
    if background:
        _write_png(folder / "images" / name, encode_bytes(image[..., :3]))
    else:
        _write_png(folder / "images" / name, encode_bytes(image[..., :3] * to_straight), alpha)
    truth = folder / "truth"
    maps = buffers * to_straight
    length = np.maximum(np.linalg.norm(maps[..., 3:6], axis=-1, keepdims=True), 1e-9)
    code = np.where(coverage[..., None] > 0, 0.5 + 0.5 * maps[..., 3:6] / length, 0.5)
    orm = np.stack([np.ones_like(coverage), maps[..., 6], maps[..., 7]], -1)
    _write_png(truth / "masks" / name, alpha)
    _write_png(truth / "albedo" / name, encode_bytes(maps[..., :3]), alpha)
    _write_png(truth / "normal" / name, np.round(255 * code).astype(np.uint8), alpha)
    _write_png(truth / "emission" / name, encode_bytes(maps[..., 8:11]), alpha)
    _write_png(truth / "orm" / name, np.round(255 * np.clip(orm, 0, 1)).astype(np.uint8), alpha)


def _transforms(cams: tuple[Camera, ...]) -> dict[str, object]:
    """NeRF's `transforms.json` for cameras that share their intrinsics."""
    first = cams[0]
    frames = [{"file_path": f"images/{c.name}.png", "transform_matrix": c.camera_to_world_opengl().tolist()} for c in cams]
    return {
        "camera_angle_x": 2 * math.atan(0.5 * first.width / first.fx),
        "fl_x": first.fx, "fl_y": first.fy, "cx": first.cx, "cy": first.cy, "w": first.width, "h": first.height,
        "frames": frames,
    }  # fmt: skip


def write_capture(
    folder: Path, views: int = 24, size: int = 128, seed: int = 0, poses: bool = True, background: bool = False, marker: bool = False
) -> None:
    """Write the capture into `folder` (created if missing).

    `images/000.png`…: sRGB photos of `size`² pixels, RGBA with transparent background, or opaque with a textured ground when `background`,
    on which with `marker` a printed ArUco marker of `scene.MARKER_SIZE` units lies; `transforms.json` when `poses`; `truth/`: `mesh.ply`,
    `points.npz` (30 000 surface points with materials), `cameras.json` (`CameraSet`), and per photo `masks/`, `albedo/` and `emission/`
    (sRGB), `normal/` (world, coded 0..1), `orm/` (1, roughness, metallic; linear).
    Equal arguments write equal bytes. `synth.json` is the mark of the folder.
    Raises UsageError for fewer than 3 views or a size below 16, and for a folder that holds other files, or photos that were edited.
    """
    if views < 3 or size < 16:
        raise UsageError(f"The built-in capture needs at least 3 views of 16 pixels, not {views} of {size}; increase --views or --size.")
    require_capture_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for left in unfinished_folders(folder):
        shutil.rmtree(left, ignore_errors=True)
    new = folder / f".synth-{uuid.uuid4().hex[:8]}"
    try:
        _write(new, views, size, seed, poses, background or marker, scene.marker_cells() if marker else scene.NO_MARKER)
        replace_capture(new, folder)
    finally:
        shutil.rmtree(new, ignore_errors=True)


def _write(folder: Path, views: int, size: int, seed: int, poses: bool, background: bool, marker: NDArray[np.uint8]) -> None:
    """Write the files of a capture into a new folder."""
    import trimesh

    truth = folder / "truth"
    for path in (folder / "images", *(truth / kind for kind in TRUTH_IMAGES)):
        path.mkdir(parents=True)
    cams = cameras(views, size, seed, background)
    rig = studio_rig()
    with ThreadPoolExecutor(2) as pool:  # the renderer releases the GIL
        list(pool.map(lambda camera: _write_view(folder, camera, rig, background, marker), cams))
    if poses:
        (folder / "transforms.json").write_bytes(json.dumps(_transforms(cams), indent=1).encode())
    CameraSet(cams, poses="given").save(truth / "cameras.json")
    vertices, faces = true_mesh()
    trimesh.Trimesh(vertices, faces, process=False).export(truth / "mesh.ply")
    np.savez_compressed(truth / "points.npz", allow_pickle=False, **surface_points(vertices, faces, 30_000, seed))
