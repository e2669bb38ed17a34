"""Estimation of the up axis from camera rotations, and the rotation that maps it to +Z."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsbake.geometry.cameras import Array

#: Cameras without roll have horizontal x axes. These determine the vertical when their smallest variance is lower by this factor.
_MIN_VARIANCE_RATIO = 8.0


def up_direction(rotations: Sequence[Array]) -> Array:
    """The up direction (3,) estimated from camera rotations (world→camera, OpenCV axes).

    The x axes of cameras without roll lie in the ground plane, so the vertical is the direction of least variance of the x axes. Where
    these do not span a plane (few photos, all from one side) it is the mean of the cameras' up directions, which is biased by their pitch.
    """
    stack = np.stack([np.asarray(r, float) for r in rotations])
    mean_up = -stack[:, 1].mean(0)
    values, vectors = np.linalg.eigh(np.einsum("ni,nj->ij", stack[:, 0], stack[:, 0]) / len(stack))
    vertical = vectors[:, 0] * np.sign(vectors[:, 0] @ mean_up or 1.0)
    length = float(np.linalg.norm(mean_up))
    level = values[1] > 0.02 and values[1] > _MIN_VARIANCE_RATIO * values[0]
    if level and (length < 1e-6 or vertical @ mean_up > 0.2 * length):
        return np.asarray(vertical)
    return np.asarray(mean_up / length if length > 1e-6 else vertical)


def upright_rotation(up: Array) -> Array:
    """The smallest rotation (3, 3) that maps the unit vector `up` to +Z."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up, z), float(up @ z)
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + cosine))
