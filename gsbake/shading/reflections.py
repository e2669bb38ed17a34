"""Rays that a surface reflects, traced on its own mesh.

Whitted, *An improved illumination model for shaded display*, CACM 1980.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.raycast import Hits, RayCaster


def trace_reflections(
    caster: RayCaster, face: NDArray[Any], position: NDArray[Any], normal: NDArray[Any], view: NDArray[Any], offset: float
) -> tuple[NDArray[np.intp], Hits]:
    """Which of n surface points (m,) send a reflected ray, and the first hits of these m rays on the mesh in `caster`.

    `face` (n,) is the face that each `position` (n, 3) lies on, `normal` (n, 3) the shading normal of any length, `view` (n, 3) the unit
    vector to the camera. Rays start `offset` above the face (mesh units); those below the geometric horizon, which would start inside, are
    left out.
    """
    shading = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    corner = caster.vertices[caster.faces[face]]
    geometric = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    geometric /= np.maximum(np.linalg.norm(geometric, axis=1, keepdims=True), 1e-20)
    ray = 2 * np.einsum("nk,nk->n", shading, view)[:, None] * shading - view
    above = np.flatnonzero(np.einsum("nk,nk->n", geometric, ray) > 0)
    return above, caster.first_hit(position[above] + offset * geometric[above], ray[above])
