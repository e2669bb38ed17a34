"""What every pose format boils down to: checked camera poses, matched to photos by file name.

The formats themselves are read in `transforms.py`, `llff.py` and `model.py`; `given.py` chooses among them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np

from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, Camera

#: Largest deviation of RᵀR from the identity that passes as rounding in a text file.
RIGID_TOLERANCE = 1e-2


@dataclass(frozen=True)
class PhotoSize:
    """Size of a source photo, upright, and the EXIF orientation that made it so."""

    width: int
    height: int
    orientation: int = 1


@dataclass(frozen=True)
class Given:
    """Poses that came with the photos, in the frame of their file.

    `cameras` by the photo's path inside the photo folder, at the size of the upright source photo; `missing` frames whose photo is not
    there; `points` (n, 3) and `colours` (n, 3) 8-bit when the file has them.
    """

    cameras: dict[str, Camera]
    missing: tuple[str, ...] = ()
    points: Array | None = None
    colours: Array | None = None


def rigid(rotation: Array, translation: Array, frame: str, source: str) -> tuple[Array, Array]:
    """The pose with its rotation made exactly orthonormal.

    Raises BadInputError naming the frame when a value is NaN or infinite, or the matrix is no rotation (scaled, sheared, mirrored).
    """
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        raise BadInputError(f"The pose of frame {frame} in {source} holds NaN or infinite values; remove the frame or solve it again.")
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise BadInputError(
            f"The pose of frame {frame} in {source} is no rigid motion (its matrix scales, shears or mirrors); export the poses again."
        )
    u, _, vt = np.linalg.svd(rotation)
    return u @ vt, np.asarray(translation, float)


def checked_intrinsics(camera: Camera, source: str) -> Camera:
    """The camera, if its intrinsics are usable; BadInputError naming the frame otherwise."""
    values = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    if not all(math.isfinite(v) for v in values) or camera.fx <= 0 or camera.fy <= 0:
        raise BadInputError(f"The intrinsics of frame {camera.name} in {source} are unusable (focal length not positive, NaN or infinite).")
    return camera


def match_frame(file: str, photos: Iterable[str]) -> str | None:
    """The photo a frame's file path means, or None: the one of the same stem that shares most trailing folders.

    Raises BadInputError when two photos fit equally well.
    """
    wanted = PurePosixPath(file.replace("\\", "/"))
    best: list[str] = []
    best_score = -1
    for photo in photos:
        path = PurePosixPath(photo)
        if path.name == wanted.name:
            score = 1
        elif path.stem in (wanted.stem, wanted.name):  # another suffix, or a frame path written without one
            score = 0
        else:
            continue
        for mine, theirs in zip(reversed(path.parts[:-1]), reversed(wanted.parts[:-1]), strict=False):
            if mine != theirs:
                break
            score += 2
        if score > best_score:
            best, best_score = [photo], score
        elif score == best_score:
            best.append(photo)
    if len(best) > 1:
        raise BadInputError(f"The frame {file} could mean any of the photos {', '.join(best)}; give them different names.")
    return best[0] if best else None


def upright(camera: Camera, orientation: int) -> Camera:
    """The camera of a photo as stored, turned to the photo with its EXIF orientation (3, 6 or 8) applied.

    The distortion is that of the turned lens: the radial terms stay, the tangential ones turn with the axes.
    """
    turns = {1: 0, 6: 1, 3: 2, 8: 3}.get(orientation, 0)  # quarter turns clockwise that make the photo upright
    for _ in range(turns):
        # Stored (x, y) comes to (height - y, x): the new x axis is the old -y, the new y axis the old x.
        turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        k = camera.distortion
        if len(k) >= 4:
            # OpenCV: xd = … + 2 p1 xy + p2 (r² + 2x²), yd = … + p1 (r² + 2y²) + 2 p2 xy; put in (x', y') = (-y, x).
            k = (k[0], k[1], k[3], -k[2], *k[4:])
        camera = replace(
            camera,
            width=camera.height,
            height=camera.width,
            fx=camera.fy,
            fy=camera.fx,
            cx=camera.height - camera.cy,
            cy=camera.cx,
            R=turn @ camera.R,
            t=turn @ camera.t,
            distortion=k,
        )
    return camera


def fit_to_photo(camera: Camera, size: PhotoSize, source: str) -> Camera:
    """The camera at the size of its upright source photo.

    A camera calibrated at another resolution is scaled; one for the photo as stored is turned. BadInputError where neither fits.
    """

    def fits(width: int, height: int) -> bool:
        return abs(camera.width / camera.height * height / width - 1) < 0.01

    if (camera.width, camera.height) == (size.width, size.height):
        return camera
    if fits(size.width, size.height):
        return camera.scaled(size.width, size.height)
    if size.orientation >= 5 and fits(size.height, size.width):
        return upright(camera.scaled(size.height, size.width), size.orientation)
    raise BadInputError(
        f"The camera of frame {camera.name} in {source} is for {camera.width}x{camera.height} pixels but its photo has "
        f"{size.width}x{size.height}; use the photos the poses were made with."
    )


def collect(frames: Iterable[tuple[str, Camera]], sizes: Mapping[str, PhotoSize], source: str) -> tuple[dict[str, Camera], tuple[str, ...]]:
    """Cameras by photo, and the frames without a photo. `frames` are (file path as written, camera).

    Raises BadInputError when two frames mean one photo or no frame has a photo.
    """
    cameras: dict[str, Camera] = {}
    missing = []
    for file, camera in frames:
        photo = match_frame(file, sizes)
        if photo is None:
            missing.append(file)
        elif photo in cameras:
            raise BadInputError(f"Two frames in {source} belong to the photo {photo}; remove one.")
        else:
            cameras[photo] = checked_intrinsics(fit_to_photo(camera, sizes[photo], source), source)
    if not cameras:
        raise BadInputError(f"No frame in {source} belongs to a photo by its file name; check that poses and photos are of one capture.")
    return cameras, tuple(missing)
