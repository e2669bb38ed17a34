"""Filling what no chart covers, and what no photo saw.

Empty texels: a rim around each chart takes the nearest chart texel, so that bilinear filtering never reads another chart; everything
farther is a smooth average pulled down an image pyramid, which keeps mip maps free of foreign colours and compresses well.
Unseen surface: values are spread over the mesh itself, as the harmonic function that continues what was seen, which follows the surface and
does not leak through a thin wall; what it misses on coarse triangles is spread from the texels around the gap.

Gortler et al., *The Lumigraph*, SIGGRAPH 1996 (pull-push).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg

from gsbake.texturing.texels import Texels

Floats = NDArray[np.float32]


def flood(image: NDArray[Any], covered: NDArray[np.bool_], rim: int) -> Floats:
    """`image` (s, s, c) with every texel that is not `covered` (s, s) filled; `rim` texels take their nearest covered one.

    Returns the image as it is when nothing is covered.
    """
    full = np.asarray(image, np.float32)
    if not covered.any() or covered.all():
        return full
    far, label = cv2.distanceTransformWithLabels((~covered).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    place = np.zeros(int(label.max()) + 1, np.int64)
    place[label[covered]] = np.flatnonzero(covered.ravel())
    near = far <= rim
    out = full.reshape(-1, full.shape[-1])[place[label]]
    smooth = _pulled(full, covered)
    blend = np.clip((far - rim) / max(rim, 1), 0, 1)[..., None].astype(np.float32)
    blend[near] = 0
    return np.asarray(out + blend * (smooth - out), np.float32)


def _pulled(image: Floats, covered: NDArray[np.bool_]) -> Floats:
    """Every texel from the finest pyramid level that knows it, smoothly enlarged."""
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


def continue_over_surface(values: NDArray[Any], seen: NDArray[np.bool_], texels: Texels, faces: NDArray[Any], vertices: int) -> Floats:
    """Texel `values` (n, c) with those not `seen` (n,) continued from the seen ones over the mesh.

    `faces` (f, 3) index the `vertices` of the mesh before it was cut into charts. A piece of which nothing was seen takes the median of all
    that was; with nothing seen at all, values stay.
    """
    given = np.asarray(values, np.float32)
    if seen.all() or not seen.any():
        return given
    triangles = np.asarray(faces, np.int64)
    columns = given.shape[1]
    corner, share = triangles[texels.face[seen]], texels.bary[seen].astype(np.float64)
    weight = np.bincount(corner.ravel(), share.ravel(), vertices)
    total = np.stack([np.bincount(corner.ravel(), (share * given[seen, k, None]).ravel(), vertices) for k in range(columns)], 1)
    known = weight > 1e-6
    vertex = np.where(known[:, None], total / np.maximum(weight, 1e-6)[:, None], np.median(given[seen], 0))

    ends = triangles[:, [0, 1, 2, 1, 2, 0]].ravel(), triangles[:, [1, 2, 0, 0, 1, 2]].ravel()
    links = coo_matrix((np.ones(6 * len(triangles)), ends), shape=(vertices, vertices)).tocsr()
    piece = connected_components(links, directed=False)[1]
    reached = np.isin(piece, piece[known])
    unknown = np.flatnonzero(~known & reached)
    if len(unknown):
        laplacian = csr_matrix(diags(np.asarray(links.sum(1)).ravel()) - links)
        inner = laplacian[unknown][:, unknown]
        right = -(laplacian[unknown][:, np.flatnonzero(known)] @ vertex[known])
        precondition = diags(1 / np.maximum(inner.diagonal(), 1e-12))
        for k in range(columns):
            vertex[unknown, k] = cg(inner, right[:, k], x0=vertex[unknown, k], rtol=1e-4, maxiter=2000, M=precondition)[0]
    smooth = np.einsum("nk,nkc->nc", texels.bary, vertex[triangles[texels.face]]).astype(np.float32)
    # What the vertices of coarse triangles cannot say, the texels around the gap do: their residual is spread in the image.
    where = texels.image(seen.astype(np.float32))[..., 0] > 0
    residual = _pulled(texels.image(np.where(seen[:, None], given - smooth, 0)), where).reshape(-1, columns)[texels.index]
    low, high = given[seen].min(0), given[seen].max(0)
    return np.where(seen[:, None], given, np.clip(smooth + residual, low, high))
