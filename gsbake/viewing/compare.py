"""Two glTF files in one frame compared: surfaces, normals, textures and renders.

Surfaces by points sampled with equal density: chamfer distance (mean of the two directed mean distances) as a share of the first file's
bounding-box diagonal, and the angle between the normals at nearest points. Textures and renders from cameras around the object, so that
different UV layouts compare: base colour, roughness, metallic and normals where both files cover a pixel, and the lit image.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.errors import BadInputError
from gsbake.geometry.mesh_process import read_foreign_mesh
from gsbake.geometry.surface_distance import surface_distances
from gsbake.geometry.vectors import unit
from gsbake.gltf.scene import Scene, open_scene
from gsbake.imaging.metrics import psnr, ssim
from gsbake.imaging.srgb import encode
from gsbake.report.render import RenderedImage, Shader
from gsbake.viewing.render import SceneRenderer
from gsbake.viewing.turntable import BACKGROUND, orbit, sheet

Doubles = NDArray[np.float64]

#: Points sampled on each surface.
SURFACE_POINTS = 100_000
#: Coverage of a pixel from which its surface is compared.
COVERED = 0.99
#: Factor of the differences in the sheet.
GAIN = 4.0


@dataclass(frozen=True)
class Surface:
    """A triangle mesh: `vertices` (v, 3), `faces` (f, 3), and unit `normals` (v, 3) or None for those of the triangles."""

    vertices: Doubles
    faces: NDArray[Any]
    normals: NDArray[Any] | None = None

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    def sample(self, count: int) -> tuple[Doubles, Doubles]:
        """`count` points (n, 3) of equal density, always the same ones, and the normals (n, 3) there."""
        corner = self.vertices[self.faces]
        cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = np.linalg.norm(cross, axis=1)
        if not area.sum() > 0:
            raise BadInputError("A mesh without area cannot be compared.")
        rng = np.random.default_rng(0)
        face = np.searchsorted(np.cumsum(area), (np.arange(count) + rng.random(count)) / count * area.sum())
        face = np.minimum(face, len(area) - 1)
        u, v = rng.random((2, count))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        weight = np.stack([1 - u - v, u, v], 1)
        points = np.einsum("nk,nkd->nd", weight, corner[face])
        if self.normals is None:
            return points, unit(cross[face])
        return points, unit(np.einsum("nk,nkd->nd", weight, self.normals[self.faces[face]].astype(np.float64)))


def surface_of(scene: Scene) -> Surface:
    """All triangles of a scene."""
    return Surface(scene.vertices, scene.faces, scene.normals)


def open_surface(path: Path) -> Surface:
    """A mesh from a glTF, PLY, OBJ or STL file. Raises BadInputError."""
    if path.suffix.lower() in (".glb", ".gltf"):
        return surface_of(open_scene(path))
    mesh = read_foreign_mesh(path)
    return Surface(mesh.vertices, mesh.faces)


def compare_surfaces(first: Surface, second: Surface, points: int = SURFACE_POINTS) -> dict[str, float]:
    """Chamfer and largest distance (shares of `first`'s diagonal), and mean angle of the normals in degrees."""
    p, n = first.sample(points)
    q, m = second.sample(points)
    there, back = surface_distances(p, second.vertices, second.faces), surface_distances(q, first.vertices, first.faces)
    nearest_there, nearest_back = cKDTree(q).query(p)[1], cKDTree(p).query(q)[1]
    angles = [_angle(n, m[nearest_there]), _angle(m, n[nearest_back])]
    return {
        "chamfer": float((there.mean() + back.mean()) / 2 / first.diagonal),
        "max_distance": float(max(there.max(), back.max()) / first.diagonal),
        "normal_degrees": float(np.mean([a.mean() for a in angles])),
    }


def compare_images(a: RenderedImage, b: RenderedImage) -> dict[str, float | None]:
    """Figures of two renders from one camera; None where no pixel is covered by both."""
    both = (a.alpha > COVERED) & (b.alpha > COVERED)
    either = (a.alpha > 0.5) | (b.alpha > 0.5)
    union, common = int(either.sum()), int(((a.alpha > 0.5) & (b.alpha > 0.5)).sum())
    seen = bool(both.any())
    over_a, over_b = a.over(BACKGROUND), b.over(BACKGROUND)
    return {
        "render_psnr": psnr(over_a, over_b, either) if union else None,
        "render_ssim": ssim(over_a, over_b, either) if union else None,
        "base_color_psnr": psnr(encode(a.base_color), encode(b.base_color), both) if seen else None,
        "roughness_error": float(np.abs(a.orm - b.orm)[both][:, 1].mean()) if seen else None,
        "metallic_error": float(np.abs(a.orm - b.orm)[both][:, 2].mean()) if seen else None,
        "shading_normal_degrees": float(_angle(a.normal[both], b.normal[both]).mean()) if seen else None,
        "silhouette_iou": common / union if union else None,
    }


def compare_files(
    first: Path, second: Path, truth: Path | None, shader: Shader, views: int, pixels: int
) -> tuple[dict[str, Any], NDArray[np.uint8]]:
    """Figures of two files (and of each against the mesh `truth`), and a sheet: first, second and their difference by row of views."""
    scenes = [open_scene(path) for path in (first, second)]
    surfaces = [surface_of(scene) for scene in scenes]
    figures: dict[str, Any] = {"files": [_summary(scene) for scene in scenes], "surface": compare_surfaces(surfaces[0], surfaces[1])}
    if truth is not None:
        true = open_surface(truth)
        figures["truth"] = {"file": str(truth), "surfaces": [compare_surfaces(true, surface) for surface in surfaces]}
    renderers = [SceneRenderer(scene) for scene in scenes]
    cameras = orbit(renderers[0].centre, renderers[0].radius, views, pixels)
    rows, images = [], []
    for camera in cameras:
        pair = [renderer.draw(camera, shader) for renderer in renderers]
        rows.append(compare_images(*pair))
        over = [np.asarray(image.over(BACKGROUND), np.float32) for image in pair]
        difference = np.clip(GAIN * np.abs(over[0] - over[1]), 0, 1)
        images += [np.asarray(np.rint(255 * image), np.uint8) for image in (*over, difference)]
    figures["views"] = views
    figures["images"] = {key: _mean([row[key] for row in rows]) for key in rows[0]}
    return figures, sheet(images, 3)


def _summary(scene: Scene) -> dict[str, Any]:
    triangles = sum(len(p.faces) for p in scene.parts)
    return {"file": scene.document.name, "bytes": scene.document.size, "triangles": triangles, "notes": list(scene.notes)}


def _mean(values: list[float | None]) -> float | None:
    found = [v for v in values if v is not None]
    return float(np.mean(found)) if found else None


def _angle(a: NDArray[Any], b: NDArray[Any]) -> Doubles:
    """Angles (n,) between unit vectors (n, 3) in degrees."""
    return np.degrees(np.arccos(np.clip(np.einsum("nd,nd->n", a.astype(np.float64), b.astype(np.float64)), -1, 1)))
