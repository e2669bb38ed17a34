"""Common part of all pose formats: validation of camera poses and matching of their frames to photos by file name.

The formats are read in `transforms_json.py`, `llff.py` and `colmap_model.py`; `given.py` selects one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np

from gsbake.capture.poses.validation import MAX_COORDINATE, ImportedCamera, validate
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, Camera
from gsbake.geometry.region import Region
from gsbake.text import missing_list, shortlist

#: Largest deviation of RᵀR from the identity that is attributed to rounding in a text file.
RIGID_TOLERANCE = 1e-2


@dataclass(frozen=True)
class PhotoSize:
    """Size of an upright source photo, and the EXIF orientation that was applied to it."""

    width: int
    height: int
    orientation: int = 1


@dataclass(frozen=True)
class GivenPoses:
    """Poses supplied by the user, in the frame of their file.

    `cameras` by the photo's path inside the photo folder, at the size of the upright source photo; `missing` frames without a photo;
    `points` (n, 3) and `colours` (n, 3) 8-bit, and the `region` to be baked, when the file has them; `notes`, what the reader changed or
    did not use, as the arguments of `Monitor.decide`; `warnings`, what it could not use.
    """

    cameras: dict[str, Camera]
    missing: tuple[str, ...] = ()
    points: Array | None = None
    colours: Array | None = None
    region: Region | None = None
    notes: tuple[tuple[str, str, str], ...] = ()
    warnings: tuple[str, ...] = ()


def checked_rigid(rotation: Array, translation: Array, frame: str, source: str) -> tuple[Array, Array]:
    """The pose with its rotation projected to the nearest orthonormal matrix.

    Raises BadInputError when a value is NaN or infinite, or the matrix is not a rotation (scaled, sheared, mirrored).
    """
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        raise BadInputError(f"The pose of frame {frame} in {source} holds NaN or infinite values; remove the frame or solve it again.")
    if np.abs(rotation).max() > 2 or np.abs(rotation.T @ rotation - np.eye(3)).max() > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise BadInputError(
            f"The pose of frame {frame} in {source} is no rigid motion (its matrix scales, shears or mirrors); export the poses again."
        )
    if np.abs(translation).max() > MAX_COORDINATE:
        far = float(np.abs(translation).max())
        raise BadInputError(f"The pose of frame {frame} in {source} is {far:.0e} units from the origin; export it again.")
    u, _, vt = np.linalg.svd(rotation)
    return u @ vt, np.asarray(translation, float)


def checked_intrinsics(camera: Camera, source: str) -> Camera:
    """The camera itself. Raises BadInputError when a value is not finite or beyond what cameras have."""
    values = {
        "width": float(camera.width), "height": float(camera.height), "fx": float(camera.fx), "fy": float(camera.fy),
        "cx": float(camera.cx), "cy": float(camera.cy), "distortion": tuple(float(k) for k in camera.distortion),
        "translation": tuple(float(x) for x in camera.t),
    }  # fmt: skip
    validate(ImportedCamera, values, f"The camera of frame {camera.name} in {source}")
    return camera


class PhotoIndex:
    """Photos by file name and by stem, for frames' file paths; a look-up takes constant time where names are unique."""

    def __init__(self, photos: Iterable[str]) -> None:
        self._by_name: dict[str, list[PurePosixPath]] = {}
        self._by_stem: dict[str, list[PurePosixPath]] = {}
        for photo in photos:
            path = PurePosixPath(photo)
            self._by_name.setdefault(path.name, []).append(path)
            self._by_stem.setdefault(path.stem, []).append(path)

    def match(self, file: str) -> str | None:
        """The photo that a frame's file path refers to, or None: the one of the same name, else stem, that shares most trailing folders.

        Raises BadInputError when two photos match equally well.
        """
        wanted = PurePosixPath(file.replace("\\", "/"))
        named = set(self._by_name.get(wanted.name, ()))
        # the same stem: another suffix, or a frame path written without one
        candidates = {*named, *self._by_stem.get(wanted.stem, ()), *self._by_stem.get(wanted.name, ())}
        scores = {path: (1 if path in named else 0) + 2 * _common_folders(path, wanted) for path in candidates}
        top = max(scores.values(), default=0)
        best = sorted(str(path) for path, score in scores.items() if score == top)
        if len(best) > 1:
            raise BadInputError(f"The frame {file} matches several photos ({shortlist(best)}); give them different names.")
        return best[0] if best else None


def _common_folders(a: PurePosixPath, b: PurePosixPath) -> int:
    """Number of equal folders directly above both files."""
    count = 0
    for mine, theirs in zip(reversed(a.parts[:-1]), reversed(b.parts[:-1]), strict=False):
        if mine != theirs:
            break
        count += 1
    return count


def rotate_upright(camera: Camera, orientation: int) -> Camera:
    """The camera of a stored photo, rotated to the upright photo of this EXIF orientation (3, 6 or 8).

    The radial distortion is unchanged; the tangential coefficients rotate with the axes.
    """
    turns = {1: 0, 6: 1, 3: 2, 8: 3}.get(orientation, 0)  # quarter turns clockwise that make the photo upright
    for _ in range(turns):
        # Stored (x, y) maps to (height - y, x): the new x axis is the old -y, the new y axis the old x.
        turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        k = camera.distortion
        if len(k) >= 4:
            # OpenCV: xd = … + 2 p1 xy + p2 (r² + 2x²), yd = … + p1 (r² + 2y²) + 2 p2 xy; substitute (x', y') = (-y, x).
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

    A camera calibrated at another resolution is scaled; one for the stored photo is rotated. Raises BadInputError when the aspect ratio
    fits neither.
    """

    def same_aspect(width: int, height: int) -> bool:
        return min(width, height) > 0 and abs(camera.width / camera.height * height / width - 1) < 0.01

    checked_intrinsics(camera, source)
    if (camera.width, camera.height) == (size.width, size.height):
        return camera
    if same_aspect(size.width, size.height):
        return camera.scaled(size.width, size.height)
    if size.orientation >= 5 and same_aspect(size.height, size.width):
        return rotate_upright(camera.scaled(size.height, size.width), size.orientation)
    raise BadInputError(
        f"The camera of frame {camera.name} in {source} is for {camera.width}x{camera.height} pixels but its photo has "
        f"{size.width}x{size.height}; use the photos the poses were made with."
    )


def match_cameras(
    frames: Iterable[tuple[str, Camera]], sizes: Mapping[str, PhotoSize], source: str
) -> tuple[dict[str, Camera], tuple[str, ...]]:
    """Cameras by photo, and the frames without a photo. `frames` are (file path as written, camera).

    Raises BadInputError when two frames match one photo or no frame matches a photo.
    """
    cameras: dict[str, Camera] = {}
    missing = []
    index = PhotoIndex(sizes)
    for file, camera in frames:
        photo = index.match(file)
        if photo is None:
            missing.append(file)
        elif photo in cameras:
            raise BadInputError(f"Two frames in {source} belong to the photo {photo}; remove one.")
        else:
            cameras[photo] = fit_to_photo(camera, sizes[photo], source)
    if not cameras:
        raise BadInputError(
            f"No frame in {source} belongs to a photo by its file name ({missing_list(missing) or 'there is no frame'}); check that poses "
            "and photos are of one capture."
        )
    return cameras, tuple(missing)
