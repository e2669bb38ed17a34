"""Pinhole cameras, similarity transforms and their JSON format.

OpenCV axes (x right, y down, z forward), world→camera `R, t`; pixel (i, j) has its centre at (i + .5, j + .5).
A `CameraSet` also stores the similarity from its frame to the world frame, so that every artifact has a scale.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: OpenCV camera axes → OpenGL camera axes (flip y and z).
OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Similarity:
    """x_world = scale * rotation @ x + translation."""

    scale: float = 1.0
    rotation: Array = field(default_factory=lambda: np.eye(3))
    translation: Array = field(default_factory=lambda: np.zeros(3))

    @staticmethod
    def between(source: Array, target: Array) -> Similarity:
        """The least-squares similarity from `source` (n, 3) to `target` (n, 3), whose points differ (Umeyama, *Least-squares estimation of
        transformation parameters between two point patterns*, PAMI 1991)."""
        mean_s, mean_t = source.mean(0), target.mean(0)
        left, spread, right = np.linalg.svd((target - mean_t).T @ (source - mean_s))
        handed = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
        rotation = (left * handed) @ right
        scale = float((spread * handed).sum() / ((source - mean_s) ** 2).sum())
        return Similarity(scale, rotation, mean_t - scale * rotation @ mean_s)

    def apply(self, points: Array) -> Array:
        """Map points (..., 3) from the source to the target frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def inverse(self) -> Similarity:
        """The map from the target to the source frame."""
        rot = self.rotation.T
        return Similarity(1.0 / self.scale, rot, -(rot @ self.translation) / self.scale)

    def then(self, outer: Similarity) -> Similarity:
        """Composition: self first, then `outer`."""
        return Similarity(outer.scale * self.scale, outer.rotation @ self.rotation, outer.apply(self.translation))

    def matrix(self) -> Array:
        """Homogeneous (4, 4) matrix."""
        out = np.eye(4)
        out[:3, :3] = self.scale * self.rotation
        out[:3, 3] = self.translation
        return out


@dataclass(frozen=True)
class Camera:
    """Camera of one photo; `distortion` is OpenCV coefficients (k1, k2, p1, p2[, k3…]), empty for a pinhole; `flash`, whether its flash
    fired, None where that is not known."""

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    R: Array
    t: Array
    distortion: tuple[float, ...] = ()
    flash: bool | None = None

    @property
    def centre(self) -> Array:
        """Camera position (3,) in the frame of the set."""
        return -self.R.T @ self.t

    @property
    def K(self) -> Array:
        """Intrinsic matrix (3, 3) in pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def view_direction(self) -> Array:
        """Unit viewing direction (3,)."""
        return self.R[2]

    def scaled(self, width: int, height: int) -> Camera:
        """The same camera for the photo resampled to width x height."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def downscaled_to(self, size: int) -> Camera:
        """The same camera for the photo reduced so that its longer side has at most `size` pixels."""
        longer = max(self.width, self.height)
        if longer <= size:
            return self
        return self.scaled(max(1, round(self.width * size / longer)), max(1, round(self.height * size / longer)))

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (n, 2) and depths (n,) of points (n, 3), without distortion; depth ≤ 0 is behind the camera."""
        cam = points @ self.R.T + self.t
        z = cam[:, 2]
        nonzero_z = np.where(np.abs(z) < 1e-12, 1e-12, z)
        return np.stack([self.fx * cam[:, 0] / nonzero_z + self.cx, self.fy * cam[:, 1] / nonzero_z + self.cy], 1), z

    def in_view(self, pixel: Array, z: Array) -> NDArray[np.bool_]:
        """Whether pixels (n, 2) with depths (n,) from `project` lie in front of the camera and inside the image (n,)."""
        return np.asarray((z > 1e-6) & (pixel >= 0).all(1) & (pixel[:, 0] < self.width) & (pixel[:, 1] < self.height))

    def rays(self) -> Array:
        """Ray directions (height, width, 3) in the set's frame through pixel centres, scaled to depth z = 1."""
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.ones(())), -1)
        return grid @ self.R

    def moved(self, frame: Similarity) -> Camera:
        """The same camera in the target frame of `frame`; depths scale with it."""
        rot = self.R @ frame.rotation.T
        centre = frame.apply(self.centre)
        return replace(self, R=rot, t=-rot @ centre)

    def camera_to_world_opengl(self) -> Array:
        """Camera-to-world matrix (4, 4) with OpenGL axes, as in `transforms.json`."""
        out = np.eye(4)
        out[:3, :3] = self.R.T @ OPENCV_TO_OPENGL
        out[:3, 3] = self.centre
        return out

    @staticmethod
    def pose_from_opengl(matrix: Array) -> tuple[Array, Array]:
        """`R, t` (world→camera, OpenCV axes) from a camera-to-world OpenGL matrix (≥ 3x4)."""
        rot = (np.asarray(matrix, float)[:3, :3] @ OPENCV_TO_OPENGL).T
        return rot, -rot @ np.asarray(matrix, float)[:3, 3]


@dataclass(frozen=True)
class CameraSet:
    """Cameras of one capture in one frame.

    `to_world` maps that frame to the Z-up world frame; `poses` is the origin of the poses ("given" or "solved");
    `metric` is True when world units are metres; `epipolar_px` is the median distance in pixels of matched features from the epipolar lines
    of given poses, None where it was not measured or too few features match.
    """

    cameras: tuple[Camera, ...]
    to_world: Similarity = Similarity()
    poses: str = "given"
    metric: bool = False
    epipolar_px: float | None = None

    def save(self, path: Path) -> None:
        """Write as JSON."""
        body = {
            "poses": self.poses,
            "metric": self.metric,
            "epipolar_px": self.epipolar_px,
            "to_world": {
                "scale": self.to_world.scale,
                "rotation": self.to_world.rotation.tolist(),
                "translation": self.to_world.translation.tolist(),
            },
            "cameras": [
                {k: getattr(c, k) for k in ("name", "width", "height", "fx", "fy", "cx", "cy", "flash")}
                | {"R": c.R.tolist(), "t": c.t.tolist(), "distortion": list(c.distortion)}
                for c in self.cameras
            ],
        }
        path.write_bytes(json.dumps(body, indent=1).encode())

    @staticmethod
    def load(path: Path) -> CameraSet:
        """Read a file written by `save`."""
        body = json.loads(path.read_text(encoding="utf-8"))
        similarity = body["to_world"]
        return CameraSet(
            cameras=tuple(
                Camera(
                    **{k: c[k] for k in ("name", "width", "height", "fx", "fy", "cx", "cy")},
                    R=np.array(c["R"], float),
                    t=np.array(c["t"], float),
                    distortion=tuple(c["distortion"]),
                    flash=c.get("flash"),
                )
                for c in body["cameras"]
            ),
            to_world=Similarity(similarity["scale"], np.array(similarity["rotation"], float), np.array(similarity["translation"], float)),
            poses=body["poses"],
            metric=body["metric"],
            epipolar_px=body.get("epipolar_px"),
        )
