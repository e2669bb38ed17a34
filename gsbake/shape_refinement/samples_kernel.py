"""Kernel that samples one photo at the vertices of a mesh: colour, its derivative along the normal, and weight.

A z-buffer of the faces that look at the camera decides what the photo sees. The derivative is that of the photo's bilinear interpolation
along the projected normal: parallax, the change of colour in linear RGB per unit of displacement.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from gsbake.kernels.declaration import kernel

#: Depth of a pixel without surface.
FAR = np.float32(1e30)
#: Least cosine between normal and ray of a sample: beyond it a pixel's footprint covers several vertices.
MIN_COSINE = 0.15
#: Steepness, as tangent of the angle of incidence, up to which the depth tolerance grows.
_MAX_TANGENT = 4.0
#: Least coverage of a sample by the mask.
_MIN_MASK = 0.5


@numba.njit(cache=True, error_model="numpy", fastmath=False)
def _rasterise(pixel: Any, faces: Any, depth: Any) -> None:
    """Fill `depth` (h, w) with the nearest z of the faces that look at the camera; `pixel` (v, 3) holds u, v and z."""
    height, width = depth.shape
    depth[:] = FAR
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        x0, y0, z0 = pixel[a, 0], pixel[a, 1], pixel[a, 2]
        x1, y1, z1 = pixel[b, 0], pixel[b, 1], pixel[b, 2]
        x2, y2, z2 = pixel[c, 0], pixel[c, 1], pixel[c, 2]
        if z0 <= 0 or z1 <= 0 or z2 <= 0:
            continue
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area >= 0:  # v points down, so outward faces that look at the camera run clockwise
            continue
        left, right = max(int(np.ceil(min(x0, x1, x2) - 0.5)), 0), min(int(np.floor(max(x0, x1, x2) - 0.5)), width - 1)
        top, bottom = max(int(np.ceil(min(y0, y1, y2) - 0.5)), 0), min(int(np.floor(max(y0, y1, y2) - 0.5)), height - 1)
        inverse = 1.0 / area
        i0, i1, i2 = 1.0 / z0, 1.0 / z1, 1.0 / z2
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                w0 = ((x1 - x) * (y2 - y) - (x2 - x) * (y1 - y)) * inverse
                w1 = ((x2 - x) * (y0 - y) - (x0 - x) * (y2 - y)) * inverse
                w2 = 1.0 - w0 - w1
                if w0 < -1e-6 or w1 < -1e-6 or w2 < -1e-6:
                    continue
                z = np.float32(1.0 / (w0 * i0 + w1 * i1 + w2 * i2))
                if z < depth[row, column]:
                    depth[row, column] = z


@kernel(
    "f8[:, ::1], f8[:, ::1], i4[:, ::1], f8[::1], f4[:, :, ::1], f4[:, ::1], i8, f4[:, :, ::1], f4[:, :, ::1], f4[:, ::1]",
    error_model="numpy", nogil=True,
)
def sample_photo(
    vertices: Any, normals: Any, faces: Any, camera: Any, photo: Any, mask: Any, view: int, colour: Any, slope: Any, weight: Any
) -> None:  # fmt: skip
    """Fill column `view` of `colour`, `slope` (v, views, 3) and `weight` (v, views) for the vertices that the photo sees; elsewhere the
    weight is 0.

    `vertices`, `normals` (v, 3); `faces` (f, 3) outward; `camera` its rotation (9), translation (3), fx, fy,
    cx, cy and centre (3); `photo` (h, w, 3) linear RGB; `mask` (h, w)
    0..1. `weight` is the cosine of incidence.
    """
    height, width = mask.shape
    count = len(vertices)
    pixel = np.empty((count, 3))
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    for v in range(count):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        depth_z = camera[6] * x + camera[7] * y + camera[8] * z + camera[11]
        pixel[v, 2] = depth_z
        if depth_z > 0:
            pixel[v, 0] = fx * (camera[0] * x + camera[1] * y + camera[2] * z + camera[9]) / depth_z + cx
            pixel[v, 1] = fy * (camera[3] * x + camera[4] * y + camera[5] * z + camera[10]) / depth_z + cy
    depth = np.empty((height, width), np.float32)
    _rasterise(pixel, faces, depth)
    per_pixel = 2.0 / (fx + fy)
    for v in range(count):
        weight[v, view] = 0
        z = pixel[v, 2]
        if z <= 0:
            continue
        dx, dy, dz = camera[16] - vertices[v, 0], camera[17] - vertices[v, 1], camera[18] - vertices[v, 2]
        n0, n1, n2 = normals[v, 0], normals[v, 1], normals[v, 2]
        cosine = (dx * n0 + dy * n1 + dz * n2) / np.sqrt(dx * dx + dy * dy + dz * dz)
        if not cosine > MIN_COSINE:
            continue
        u, w = pixel[v, 0] - 0.5, pixel[v, 1] - 0.5
        if not (u >= 0 and w >= 0 and u < width - 1 and w < height - 1):
            continue
        column, row = int(u), int(w)
        tangent = np.sqrt(max(1 - cosine * cosine, 0.0)) / cosine
        tolerance = z * per_pixel * (1 + 1.5 * min(tangent, _MAX_TANGENT))
        hidden, near = False, 0
        for k in range(4):
            d = depth[row + k // 2, column + k % 2]
            hidden = hidden or d < z - tolerance
            near += d < z + 4 * tolerance
        if hidden or near < 2:
            continue
        a, b = u - column, w - row
        w00, w01, w10, w11 = (1 - b) * (1 - a), (1 - b) * a, b * (1 - a), b * a
        covered = w00 * mask[row, column] + w01 * mask[row, column + 1] + w10 * mask[row + 1, column] + w11 * mask[row + 1, column + 1]
        if covered < _MIN_MASK:
            continue
        m0 = camera[0] * n0 + camera[1] * n1 + camera[2] * n2
        m1 = camera[3] * n0 + camera[4] * n1 + camera[5] * n2
        m2 = camera[6] * n0 + camera[7] * n1 + camera[8] * n2
        du, dw = (fx * m0 - (pixel[v, 0] - cx) * m2) / z, (fy * m1 - (pixel[v, 1] - cy) * m2) / z
        for c in range(3):
            p, q, r, s = photo[row, column, c], photo[row, column + 1, c], photo[row + 1, column, c], photo[row + 1, column + 1, c]
            colour[v, view, c] = w00 * p + w01 * q + w10 * r + w11 * s
            slope[v, view, c] = du * ((1 - b) * (q - p) + b * (s - r)) + dw * ((1 - a) * (r - p) + a * (s - q))
        weight[v, view] = cosine
