"""Filling of empty texels, and inpainting of the unobserved surface.

Empty texels: a gutter around each chart takes the nearest chart texel, so that bilinear filtering never reads another chart; everything
farther is a smooth average from an image pyramid (pull-push), which keeps mip maps free of foreign colours and compresses well.
Unobserved surface: values are extended over the mesh as a harmonic function, which follows the surface and does not leak through a thin
wall; its residual on coarse triangles is interpolated in the texture from the texels around the gap.

Gortler et al., *The Lumigraph*, SIGGRAPH 1996 (pull-push).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components

from gsbake.geometry.conjugate_gradients import conjugate_gradients
from gsbake.texturing.texels import Texels

Floats = NDArray[np.float32]


def fill_empty_texels(image: NDArray[Any], covered: NDArray[np.bool_], gutter: int) -> Floats:
    """`image` (s, s, c) with every texel that is not `covered` (s, s) filled; within `gutter` texels of a chart by the nearest texel.

    Unchanged when nothing is covered.
    """
    full = np.asarray(image, np.float32)
    if not covered.any() or covered.all():
        return full
    distance, label = cv2.distanceTransformWithLabels((~covered).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    nearest = np.zeros(int(label.max()) + 1, np.int64)
    nearest[label[covered]] = np.flatnonzero(covered.ravel())
    out = full.reshape(-1, full.shape[-1])[nearest[label]]
    smooth = _pull_push(full, covered)
    blend = np.clip((distance - gutter) / max(gutter, 1), 0, 1)[..., None].astype(np.float32)
    blend[distance <= gutter] = 0
    return np.asarray(out + blend * (smooth - out), np.float32)


def _pull_push(image: Floats, covered: NDArray[np.bool_]) -> Floats:
    """Every texel from the finest pyramid level with data there, smoothly upsampled."""
    weight = covered.astype(np.float32)
    level = image * weight[..., None]
    levels: list[tuple[Floats, Floats]] = [(level, weight)]
    while min(weight.shape) > 1:
        height, width = weight.shape[0] // 2, weight.shape[1] // 2
        level = np.asarray(cv2.resize(level, (width, height), interpolation=cv2.INTER_AREA), np.float32).reshape(height, width, -1)
        weight = np.asarray(cv2.resize(weight, (width, height), interpolation=cv2.INTER_AREA), np.float32)
        levels.append((level, weight))
    colour, known = levels[-1]
    out = np.asarray(colour / np.maximum(known, 1e-12)[..., None], np.float32)
    for colour, known in reversed(levels[:-1]):
        height, width = known.shape
        out = np.asarray(cv2.resize(out, (width, height), interpolation=cv2.INTER_LINEAR), np.float32).reshape(height, width, -1)
        share = np.minimum(1, 2 * known)[..., None]
        out = np.asarray(share * (colour / np.maximum(known, 1e-12)[..., None]) + (1 - share) * out, np.float32)
    return out


def inpaint_surface(values: NDArray[Any], observed: NDArray[np.bool_], texels: Texels, faces: NDArray[Any], vertices: int) -> Floats:
    """Texel `values` (n, c) with those that are not `observed` (n,) inpainted over the mesh.

    `faces` (f, 3) index the `vertices` of the mesh before unwrapping. A component without observations takes the median of all observed
    texels. Unchanged when nothing is observed.
    """
    original = np.asarray(values, np.float32)
    if observed.all() or not observed.any():
        return original
    triangles = np.asarray(faces, np.int64)
    columns = original.shape[1]
    corner, share = triangles[texels.face[observed]], texels.bary[observed].astype(np.float64)
    weight = np.bincount(corner.ravel(), share.ravel(), vertices)
    total = np.stack([np.bincount(corner.ravel(), (share * original[observed, k, None]).ravel(), vertices) for k in range(columns)], 1)
    known = weight > 1e-6
    vertex = np.where(known[:, None], total / np.maximum(weight, 1e-6)[:, None], np.median(original[observed], 0))

    ends = triangles[:, [0, 1, 2, 1, 2, 0]].ravel(), triangles[:, [1, 2, 0, 0, 1, 2]].ravel()
    adjacency = coo_matrix((np.ones(6 * len(triangles)), ends), shape=(vertices, vertices)).tocsr()
    component = connected_components(adjacency, directed=False)[1]
    reached = np.isin(component, component[known])
    unknown = np.flatnonzero(~known & reached)
    if len(unknown):
        laplacian = csr_matrix(diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency)
        inner = laplacian[unknown][:, unknown]
        right = -(laplacian[unknown][:, np.flatnonzero(known)] @ vertex[known])
        for k in range(columns):
            vertex[unknown, k] = conjugate_gradients(inner, right[:, k], 1e-4, 2000, vertex[unknown, k])
    smooth = np.einsum("nk,nkc->nc", texels.bary, vertex[triangles[texels.face]]).astype(np.float32)
    # Vertices of coarse triangles miss detail that the texels around the gap have: their residual is interpolated in the texture.
    where = texels.image(observed.astype(np.float32))[..., 0] > 0
    residual = _pull_push(texels.image(np.where(observed[:, None], original - smooth, 0)), where).reshape(-1, columns)[texels.index]
    low, high = original[observed].min(0), original[observed].max(0)
    return np.where(observed[:, None], original, np.clip(smooth + residual, low, high))
