"""What each photo says at each vertex of a mesh: photos blurred inside their masks, and samples of all at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Camera
from gsbake.imaging.srgb import decode_bytes
from gsbake.kernels.threads import run_chunks
from gsbake.shape_refinement.samples_kernel import sample_photo

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

#: Linear value above which a sample may be clipped, and the factor of its weight.
CLIPPED, CLIPPED_WEIGHT = 0.98, 0.3


@dataclass(frozen=True)
class Photo:
    """A photo for refinement: `rgb` (h, w, 3) linear, `mask` (h, w) 0..1, and its camera."""

    camera: Camera
    rgb: Floats
    mask: Floats


@dataclass(frozen=True)
class VertexSamples:
    """Samples of all photos at all vertices: `colour` (v, views, 3) linear RGB, `slope` (v, views, 3) its change per unit of displacement
    along the normal, `weight` (v, views), 0 where a photo does not see the vertex."""

    colour: Floats
    slope: Floats
    weight: Floats


def load_photos(
    posed: PosedPhotos, indices: Sequence[int], max_size: int, blur: float, check_stop: Callable[[], None] = lambda: None
) -> list[Photo]:
    """These photos, the longer side at most `max_size` pixels, blurred by a Gaussian of `blur` pixels that does not cross the masks;
    `check_stop` is called before each."""
    photos = []
    for index in indices:
        check_stop()
        view = posed.view(index, max_size)
        rgb = decode_bytes(view.rgb).astype(np.float32)
        mask = np.ones(rgb.shape[:2], np.float32) if view.mask is None else np.asarray(view.mask / np.float32(255), np.float32)
        if blur > 0:
            share = cv2.GaussianBlur(mask, (0, 0), blur)
            inside = cv2.GaussianBlur(rgb * mask[..., None], (0, 0), blur)
            rgb = np.where((share > 0.02)[..., None], inside / np.maximum(share, 1e-4)[..., None], rgb)
        photos.append(Photo(view.camera, np.ascontiguousarray(rgb, np.float32), mask))
    return photos


def sample_photos(vertices: Doubles, normals: Doubles, faces: NDArray[np.int32], photos: Sequence[Photo]) -> VertexSamples:
    """Samples of the photos at the vertices (v, 3) with unit `normals`; each photo's column is filled by one thread."""
    shape = (len(vertices), len(photos))
    out = VertexSamples(np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32))
    vertices, normals = np.ascontiguousarray(vertices), np.ascontiguousarray(normals)

    def sample(start: int, stop: int) -> None:
        for index in range(start, stop):
            photo = photos[index]
            sample_photo(
                vertices, normals, faces, camera_row(photo.camera), photo.rgb, photo.mask, index, out.colour, out.slope, out.weight
            )

    run_chunks(sample, len(photos))
    out.weight[out.colour.max(2) > CLIPPED] *= CLIPPED_WEIGHT
    return out


def camera_row(camera: Camera) -> Doubles:
    """The camera as `sample_photo` reads it."""
    return np.concatenate([camera.R.ravel(), camera.t, [camera.fx, camera.fy, camera.cx, camera.cy], camera.centre])
