"""The baked maps on a coarser mesh with charts of its own, for budgets below what the seams of the bake allow.

A decimated mesh that keeps its charts keeps their seams, which need triangles and vertices of their own: a real object of a thousand charts
does not get below some ten thousand triangles. Here the surface is decimated without seams and unwrapped again; each of its texels takes
its values from the baked surface along its normal, as normal maps are made (Cohen, Olano & Manocha, *Appearance-preserving
simplification*, SIGGRAPH 1998). Values are interpolated once more, so maps lose sharpness; no photo is read.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.geometry.raycast import RayCaster
from gsbake.geometry.tangents import world_to_frame
from gsbake.gltf.write import GltfMesh
from gsbake.meshing.decimation import decimate_to_error_bound
from gsbake.meshing.decimator_choice import Decimator
from gsbake.targets.maps import BakedMaps, MapSource, resized
from gsbake.texturing.atlas import make_atlas
from gsbake.texturing.inpainting import fill_empty_texels
from gsbake.texturing.normal_map import hits_along_normals
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh

Floats = NDArray[np.float32]

#: Edge of the maps that values are read from over that of the new ones: a finer one would be undersampled.
OVERSAMPLING = 2
#: Columns of the images in which points are handed to OpenCV.
WIDTH = 1024


def with_new_charts(
    source: MapSource,
    surface: tuple[NDArray[np.float64], NDArray[Any]],
    triangles: int,
    edge: int,
    decimator: Decimator,
    threads: int,
) -> MapSource:
    """Maps of `edge` texels on a mesh of about `triangles`.

    `surface`: the baked mesh as vertices (v, 3) and faces (f, 3) without seams. Raises BadInputError when nothing of it is left, or it
    cannot be unwrapped.
    """
    low = decimate_to_error_bound(*surface, triangles, triangles, 0.0, decimator)
    try:
        atlas = make_atlas(low.vertices, low.faces, edge)
    except ValueError as error:
        raise BadInputError(f"targets: the mesh of {triangles} triangles cannot be unwrapped: {error}.") from error
    new = UnwrappedMesh.of(low.vertices, low.faces, atlas, edge, threads)
    position, smooth, tangents, coordinates = (np.asarray(v, np.float32) for v in (new.position, new.normal, new.tangent, new.atlas.uv))
    mesh = GltfMesh(position, smooth, tangents, coordinates, new.atlas.faces)

    baked = source.maps
    caster = RayCaster(baked.mesh.position, baked.mesh.faces, threads)
    hits, _ = hits_along_normals(new.texel_position, new.texel_normal, caster, baked.mesh.normal, new.diagonal)
    found = hits.hit
    corner = baked.mesh.faces[np.maximum(hits.face, 0)]
    uv = np.einsum("nk,nkd->nd", hits.bary, baked.mesh.uv[corner])
    covered = new.texels.image(found)[..., 0] > 0
    size = min(baked.edge, OVERSAMPLING * edge)

    def moved(image: Floats) -> Floats:
        """Values (n, 3) of a baked texture (s, s, 3) at the new texels."""
        return _sampled(resized(image, size), uv)

    def filled(values: NDArray[Any]) -> Floats:
        return fill_empty_texels(new.texels.image(values), covered, gutter=max(2, edge // 256))

    world = _sampled(source.world_normals(size), uv)
    normal, tangent = (new.texels.interpolate(values, mesh.faces) for values in (mesh.normal, mesh.tangent))
    local = world_to_frame(world, normal, tangent)
    local[~(np.isfinite(local).all(1) & (local[:, 2] > 0.05))] = (0.0, 0.0, 1.0)
    emissive = None if baked.emissive is None else filled(moved(baked.emissive))
    return MapSource(BakedMaps(mesh, filled(moved(baked.base_color)), filled(moved(baked.orm)), filled(0.5 + 0.5 * local), emissive))


def _sampled(image: Floats, uv: NDArray[Any]) -> Floats:
    """Values (n, c) of an image (s, s, c) at texture coordinates (n, 2) with the origin at the top left, interpolated bilinearly."""
    rows = -(-len(uv) // WIDTH)  # OpenCV's images have at most 2^15 rows and columns
    places = np.pad(uv * image.shape[0] - 0.5, ((0, rows * WIDTH - len(uv)), (0, 0))).astype(np.float32).reshape(rows, WIDTH, 2)
    x, y = (np.ascontiguousarray(places[..., k]) for k in range(2))
    found = cv2.remap(np.ascontiguousarray(image), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.float32).reshape(rows * WIDTH, -1)[: len(uv)]
