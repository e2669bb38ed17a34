"""Error of a mesh against ground truth: Chamfer distance, F-score and normal error on the visible surface.

python -m benchmarks.truth CAPTURE MESH [--cameras cameras.json] [--json]

CAPTURE has the ground truth in `gt/` (`asset.glb`, and `train.json` with the true cameras) or, written by `gsbake synth`, in `truth/`. MESH
is a GLB in the asset's frame or a PLY in the Z-up world frame. With `--cameras` (the `cameras.json` beside the asset) the mesh is aligned
with the ground truth by its cameras and then by iterative closest points, which is necessary for photos without poses.

The measures are those of point-sampled surface benchmarks (Seitz et al. 2006; Knapitsch et al. 2017): points spread evenly over the part of
either surface that two cameras see unobstructed, with their distances to the whole other surface, in % of the diagonal of the true bounding
box. Chamfer is the mean of the two mean distances, the F-score counts distances below 1 %, and the normal error is the mean angle between
the face of a point and the nearest face, in both directions.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.errors import UsageError
from gsbake.geometry.cameras import CameraSet, Similarity
from gsbake.geometry.raycast import RayCaster

Array = NDArray[np.float64]

#: Points per surface, before those visible in fewer than two cameras are dropped.
SAMPLE_COUNT = 60_000
#: Points whose faces are candidates for the nearest face, and candidates per query.
ANCHOR_COUNT, CANDIDATE_COUNT = 300_000, 6
#: Points of the mesh and of the ground truth for the alignment.
ALIGNMENT_POINTS = (20_000, 100_000)
#: Random triples of cameras for the least median of squares fit.
TRIPLE_COUNT = 200
#: Minimum cosine between the normal and the direction to the camera of a visible point.
MIN_FACING = 0.15
#: Threshold of the F-score as a share of the true diagonal.
FSCORE_THRESHOLD = 0.01
#: Offset of ray origins from the surface as a share of the diagonal, against self-intersection.
RAY_OFFSET = 1e-3
#: Rotation from glTF's +Y up to the Z-up world.
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class Figures:
    """Error of a mesh: distances in % of the true diagonal, F-score at 1 % of it (0..1), angle in degrees."""

    accuracy_pct: float
    completeness_pct: float
    chamfer_pct: float
    fscore: float
    normal_deg: float


@dataclass(frozen=True)
class Surface:
    """A triangle mesh: `vertices` (v, 3) in the Z-up world frame, `faces` (f, 3)."""

    vertices: Array
    faces: NDArray[np.int64]

    @cached_property
    def corners(self) -> Array:
        """The corners of the faces (f, 3, 3)."""
        return self.vertices[self.faces]

    @cached_property
    def area_normals(self) -> Array:
        """Face normals (f, 3) with twice the area as length."""
        a, b, c = self.corners.transpose(1, 0, 2)
        return np.cross(b - a, c - a)

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box."""
        used = self.corners.reshape(-1, 3)
        return float(np.linalg.norm(np.ptp(used, 0)))

    def moved(self, frame: Similarity) -> Surface:
        """The mesh in the outer frame of `frame`."""
        return Surface(frame.apply(self.vertices), self.faces)

    def sample(self, count: int, seed: int) -> tuple[Array, NDArray[np.int64]]:
        """`count` points (n, 3) spread evenly over the area, and the face that each lies on (n,)."""
        draw = np.random.default_rng(seed)
        area = np.linalg.norm(self.area_normals, axis=1)
        face = draw.choice(len(self.faces), count, p=area / area.sum())
        u, v = np.sqrt(draw.random(count)), draw.random(count)
        weights = np.stack([1 - u, u * (1 - v), u * v], 1)
        return np.einsum("nk,nkc->nc", weights, self.corners[face]), face

    def normals(self, face: NDArray[np.int64]) -> Array:
        """Unit normals (n, 3) of the faces with indices `face` (n,)."""
        area_normals = self.area_normals[face]
        return area_normals / np.maximum(np.linalg.norm(area_normals, axis=1, keepdims=True), 1e-300)


@dataclass(frozen=True)
class Truth:
    """Ground truth in the world frame: surface, and camera centres (3,) by photo name (the file's stem)."""

    surface: Surface
    centres: Mapping[str, Array]


def read_mesh(path: Path) -> Surface:
    """A GLB (rotated from glTF's frame) or PLY (unchanged) as one surface in the Z-up frame.

    Raises UsageError without the file or without triangles in it.
    """
    import trimesh

    if not path.is_file():
        raise UsageError(f"There is no mesh {path}.")
    mesh = trimesh.load(path, force="mesh", process=False)
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise UsageError(f"{path} has no triangles; give a GLB or PLY mesh.")
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    return Surface(vertices @ Z_UP.T if path.suffix.lower() in (".glb", ".gltf") else vertices, faces)


def read_truth(capture: Path) -> Truth:
    """Ground truth of a capture. Raises UsageError without it."""
    shared, built_in = capture / "gt", capture / "truth"
    if (shared / "asset.glb").is_file() and (shared / "train.json").is_file():
        body = json.loads((shared / "train.json").read_text())
        centres = {Path(name).stem: np.array(pose, float)[:3, 3] for name, pose in zip(body["names"], body["c2w"], strict=True)}
        return Truth(read_mesh(shared / "asset.glb"), centres)
    if (built_in / "mesh.ply").is_file():
        cameras = CameraSet.load(built_in / "cameras.json").cameras
        return Truth(read_mesh(built_in / "mesh.ply"), {c.name: c.centre for c in cameras})
    raise UsageError(f"{capture} has no ground truth: neither gt/asset.glb with gt/train.json nor truth/mesh.ply.")


def read_centres(path: Path) -> dict[str, Array]:
    """Camera centres (3,) by name from a `cameras.json`: of the asset (rotated to Z-up) or of a `CameraSet` (in the world frame)."""
    body = json.loads(path.read_text())
    if "frames" in body:
        return {Path(f["file_path"]).stem: Z_UP @ np.array(f["transform_matrix"], float)[:3, 3] for f in body["frames"]}
    cameras = CameraSet.load(path)
    return {c.name: cameras.to_world.apply(c.centre) for c in cameras.cameras}


def fit_robustly(source: Array, target: Array) -> Similarity:
    """Similarity between matched points (n, 3), n ≥ 3, with outliers (wrong camera poses).

    Least median of squares over random triples (Rousseeuw 1984), then least squares over the inliers.
    """

    def residuals(frame: Similarity) -> Array:
        return np.asarray(np.linalg.norm(frame.apply(source) - target, axis=1))

    draw = np.random.default_rng(0)
    triples = [draw.choice(len(source), 3, replace=False) for _ in range(TRIPLE_COUNT)]
    frame = min((Similarity.between(source[t], target[t]) for t in triples), key=lambda f: float(np.median(residuals(f))))
    for _ in range(3):
        good = residuals(frame) <= max(3 * float(np.median(residuals(frame))), 1e-9)
        frame = Similarity.between(source[good], target[good])
    return frame


def camera_frame(centres: Mapping[str, Array], truth: Truth) -> Similarity:
    """Similarity from a reconstruction to the ground truth by its camera `centres` (3,). Raises UsageError when fewer than three match by
    name."""
    names = sorted(centres.keys() & truth.centres.keys())
    if len(names) < 3:
        raise UsageError(f"{len(names)} of the {len(truth.centres)} true cameras were found by name; the alignment takes 3.")
    return fit_robustly(np.array([centres[n] for n in names]), np.array([truth.centres[n] for n in names]))


def align(surface: Surface, centres: Mapping[str, Array], truth: Truth) -> Similarity:
    """`align_points` of points on a reconstructed surface."""
    return align_points(surface.sample(ALIGNMENT_POINTS[0], 5)[0], centres, truth)


def align_points(points: Array, centres: Mapping[str, Array], truth: Truth) -> Similarity:
    """Similarity from a reconstruction to the ground truth: from camera `centres`, then ICP of `points` (n, 3) with a shrinking threshold.

    Raises UsageError when fewer than three cameras match by name.
    """
    frame = camera_frame(centres, truth)
    reach = 0.05 * truth.surface.diagonal
    anchors = truth.surface.sample(ALIGNMENT_POINTS[1], 6)[0]
    tree = cKDTree(anchors)
    for _ in range(30):
        far, nearest = tree.query(frame.apply(points))
        close = far < max(reach, float(np.quantile(far, 0.7)))
        frame = Similarity.between(points[close], anchors[nearest[close]])
        reach *= 0.85
    return frame


def visible(surface: Surface, points: Array, normals: Array, centres: Array, lift: float) -> NDArray[np.bool_]:
    """Which points (n,) on the surface are visible from at least two camera centres (m, 3)."""
    caster = RayCaster(surface.vertices, surface.faces)
    count = np.zeros(len(points), int)
    for centre in centres:
        ray = centre - points
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        index = np.flatnonzero(((ray * normals).sum(1) > MIN_FACING) & (count < 2))
        start = points[index] + lift * (normals[index] + ray[index])
        count[index] += ~caster.occluded(start, ray[index])
    return count >= 2


def nearest_on_faces(points: Array, corners: Array) -> Array:
    """The nearest point (n, 3) of each triangle (n, 3, 3) to its point (n, 3).

    The orthogonal projection where it lies inside the triangle (barycentric coordinates all positive), else the nearest projection to the
    three edges.
    """
    a, b, c = corners.transpose(1, 0, 2)
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11 = (ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)
    d20, d21 = (ap * ab).sum(1), (ap * ac).sum(1)
    size = d00 * d11 - d01 * d01
    safe = np.where(size > 0, size, 1.0)
    v, w = (d11 * d20 - d01 * d21) / safe, (d00 * d21 - d01 * d20) / safe
    best = a + v[:, None] * ab + w[:, None] * ac
    inside = (size > 0) & (v >= 0) & (w >= 0) & (v + w <= 1)
    least = np.where(inside, 0.0, np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        share = ((points - start) * along).sum(1) / np.maximum((along * along).sum(1), 1e-300)
        foot = start + np.clip(share, 0, 1)[:, None] * along
        far = ((points - foot) ** 2).sum(1)
        better = far < least
        best[better], least[better] = foot[better], far[better]
    return best


def nearest(points: Array, surface: Surface, seed: int) -> tuple[Array, NDArray[np.int64]]:
    """Distance (n,) of points (n, 3) to the surface and the nearest face (n,), among the faces of the nearest anchor points."""
    anchors, faces = surface.sample(ANCHOR_COUNT, seed)
    candidates = faces[cKDTree(anchors).query(points, k=CANDIDATE_COUNT)[1]]
    distance = np.full(len(points), np.inf)
    face = candidates[:, 0].copy()
    for k in range(CANDIDATE_COUNT):
        far = np.linalg.norm(points - nearest_on_faces(points, surface.corners[candidates[:, k]]), axis=1)
        better = far < distance
        distance[better], face[better] = far[better], candidates[better, k]
    return distance, face


def directed_distances(source: Surface, target: Surface, centres: Array, diagonal: float, seed: int) -> tuple[Array, Array]:
    """Distances (n,) and angles in degrees (n,) from the visible part of one surface to the other surface."""
    points, faces = source.sample(SAMPLE_COUNT, seed)
    normals = source.normals(faces)
    keep = visible(source, points, normals, centres, RAY_OFFSET * diagonal)
    distance, matched = nearest(points[keep], target, seed + 1)
    cosine = (normals[keep] * target.normals(matched)).sum(1)
    return distance, np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def measure(mesh: Surface, truth: Truth) -> Figures:
    """Figures of a mesh in the frame of the ground truth. Raises UsageError when the cameras see nothing of it."""
    centres, diagonal = np.array(list(truth.centres.values())), truth.surface.diagonal
    there, there_deg = directed_distances(mesh, truth.surface, centres, diagonal, 1)
    back, back_deg = directed_distances(truth.surface, mesh, centres, diagonal, 3)
    if not len(there) or not len(back):
        raise UsageError("The cameras see nothing of the mesh; is it in another frame (--cameras)?")
    precision, recall = float((there < FSCORE_THRESHOLD * diagonal).mean()), float((back < FSCORE_THRESHOLD * diagonal).mean())
    accuracy, completeness = (100 * float(d.mean()) / diagonal for d in (there, back))
    return Figures(
        accuracy_pct=accuracy,
        completeness_pct=completeness,
        chamfer_pct=(accuracy + completeness) / 2,
        fscore=2 * precision * recall / max(precision + recall, 1e-9),
        normal_deg=float(there_deg.mean() + back_deg.mean()) / 2,
    )


def measure_aligned(mesh: Surface, centres: Mapping[str, Array], truth: Truth) -> Figures:
    """Figures of a mesh in any frame, aligned by its camera centres (3,) by name in that frame."""
    return measure(mesh.moved(align(mesh, centres, truth)), truth)


def measure_file(mesh: Path, capture: Path, cameras: Path | None = None) -> Figures:
    """Figures of an asset, aligned by its `cameras.json` if given."""
    truth, surface = read_truth(capture), read_mesh(mesh)
    return measure_aligned(surface, read_centres(cameras), truth) if cameras else measure(surface, truth)


def measure_stage(mesh: Path, poses: Path, capture: Path) -> Figures:
    """Figures of a mesh stage's PLY (unit frame) with its poses stage's `cameras.json`; aligned unless the poses were given."""
    truth, cameras = read_truth(capture), CameraSet.load(poses / "cameras.json")
    world = read_mesh(mesh).moved(cameras.to_world)
    return measure(world, truth) if cameras.poses == "given" else measure_aligned(world, read_centres(poses / "cameras.json"), truth)


def main(arguments: list[str] | None = None) -> None:
    """Measure one mesh and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--cameras", type=Path)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(arguments)
    try:
        figures: dict[str, Any] = asdict(measure_file(args.mesh, args.capture, args.cameras))
    except UsageError as error:
        parser.error(str(error))
    text = json.dumps(figures) if args.json else "  ".join(f"{k} {v:.4g}" for k, v in figures.items())
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
