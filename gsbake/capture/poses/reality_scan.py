"""Cameras of RealityScan (RealityCapture): *Internal/External camera parameters* as CSV, and XMP files beside the photos.

Both have the focal length for a sensor whose longer side is 36 mm, and the principal point from the centre of the photo in shares of its
longer side. With x = X/Z, y = Y/Z, r² = x² + y² a point is seen at (*XMP Camera Math*, Capturing Reality)

    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + t1 (r² + 2x²) + 2 t2 xy
    y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + t2 (r² + 2y²) + 2 t1 xy

which is OpenCV's model with the tangential coefficients exchanged. An XMP file has the world→camera rotation by rows (x right, y down, z
forward) and the camera's position. The CSV has angles in degrees: the camera-to-world rotation with OpenGL axes is
Rz(−heading) Rx(pitch) Ry(roll). A visible k4, skew, pixels that are not square, and the division model are refused.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from gsbake.capture.poses.frames import GivenPoses, PhotoIndex, PhotoSize, checked_rigid, match_cameras
from gsbake.capture.poses.validation import MAX_FRAMES, read_file, read_xml, refuse_coefficient
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, Camera
from gsbake.text import missing_list

#: Longer side of the sensor in mm that focal lengths are for.
SENSOR = 36.0
#: Columns that a CSV file must have; those of the principal point and the distortion may be left out.
REQUIRED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "t1", "t2")
_XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
_MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2", "division")


def read_reality_scan_csv(path: Path, sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """Poses of a CSV file for the photos in `sizes`.

    Raises BadInputError for an invalid file, a value that is not finite or out of bounds, and a coefficient that is not supported.
    """
    text = read_file(path).decode("utf-8-sig", "replace").lstrip()
    if text.startswith("#cameras"):  # an optional first line with the number of cameras
        text = text.partition("\n")[2]
    index = PhotoIndex(sizes)
    frames: list[tuple[str, Camera]] = []
    try:
        rows = csv.reader(io.StringIO(text))
        header = [name.strip().lstrip("#").lower() for name in next(rows, [])]
        if absent := [name for name in REQUIRED if name not in header]:
            raise BadInputError(
                f"{path} lacks columns ({missing_list(absent)}); export Internal/External camera parameters, with all columns, from "
                "RealityScan."
            )
        for number, row in enumerate(rows, 2):
            if not row:
                continue
            if len(frames) == MAX_FRAMES:
                raise BadInputError(f"{path} has more than {MAX_FRAMES} cameras.")
            cells = dict(zip(header, row, strict=True))
            name = cells.pop("name").strip()
            value = {column: float(cell) for column, cell in cells.items() if column in (*REQUIRED, "px", "py", *_COEFFICIENTS)}
            if not name or not all(map(math.isfinite, value.values())):
                raise ValueError(f"row {number} has no name, or a number that is not finite")
            angles = [-value["heading"], value["pitch"], value["roll"]]
            rotation = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
            rotation, centre = checked_rigid(rotation, np.array([value["x"], value["y"], value["alt"]]), name, str(path))
            pose = Camera.pose_from_opengl(np.column_stack([rotation, centre]))
            k = [value.get(c, 0.0) for c in _COEFFICIENTS]
            principal = value.get("px", 0.0), value.get("py", 0.0)
            frames.append((name, _camera(name, pose, value["f"], principal, k, _size(name, index, sizes), str(path))))
    except (ValueError, csv.Error, OverflowError) as error:
        raise BadInputError(f"{path} is not a valid CSV file of RealityScan ({' '.join(str(error).split())[:200]}).") from error
    cameras, missing = match_cameras(frames, sizes, str(path))
    return GivenPoses(cameras, missing)


def read_reality_scan_xmp(folder: Path, sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """Poses of a folder of XMP files, each named as its photo, for the photos in `sizes`; files without a position are left out.

    Raises BadInputError as `read_reality_scan_csv`.
    """
    index, frames = PhotoIndex(sizes), []
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".xmp")
    if len(files) > MAX_FRAMES:
        raise BadInputError(f"{folder} has more than {MAX_FRAMES} cameras.")
    placed = [(file, root) for file in files if _value(root := read_xml(file, "XMP file of RealityScan"), "Position") is not None]
    lacking = [f"{file.name}: {field}" for file, root in placed for field in ("Rotation", "FocalLength35mm") if _value(root, field) is None]
    if lacking:
        raise BadInputError(f"XMP files in {folder} lack fields ({missing_list(lacking)}); export them again from RealityScan.")
    for file, root in placed:
        try:
            camera = _xmp_camera(root, file, _size(file.stem, index, sizes))
        except (ValueError, OverflowError) as error:
            raise BadInputError(f"{file} is not a valid XMP file of RealityScan ({' '.join(str(error).split())[:200]}).") from error
        frames.append((file.stem, camera))
    if not frames:
        raise BadInputError(f"No XMP file in {folder} has a position; align the photos in RealityScan and export the metadata (XMP) again.")
    cameras, missing = match_cameras(frames, sizes, str(folder))
    return GivenPoses(cameras, missing)


def _xmp_camera(root: ElementTree.Element, file: Path, size: PhotoSize) -> Camera:
    def numbers(name: str, count: int, default: str | None = None) -> list[float]:
        text = _value(root, name) or default
        found = [float(x) for x in text.split()] if text is not None else []
        if len(found) != count or not all(map(math.isfinite, found)):
            raise ValueError(f"{name} has {len(found)} numbers, or one that is not finite, instead of {count}")
        return found

    rotation = np.array(numbers("Rotation", 9)).reshape(3, 3)
    R, centre = checked_rigid(rotation, np.array(numbers("Position", 3)), file.stem, str(file))
    model = _value(root, "DistortionModel") or "perspective"
    k = [float(x) for x in (_value(root, "DistortionCoeficients") or "").split()]
    k += [0.0] * (6 - len(k))
    if model not in _MODELS or len(k) != 6 or not all(map(math.isfinite, k)) or (model == "division" and any(k)):
        raise BadInputError(f"The distortion model {model} of {file} is not supported; use brown3 or brown3t2 as the final model.")
    (focal,), (skew,), (aspect,) = numbers("FocalLength35mm", 1), numbers("Skew", 1, "0"), numbers("AspectRatio", 1, "1")
    if skew or aspect != 1:
        raise BadInputError(f"The camera of {file} has skew or pixels that are not square; undistort the photos first.")
    principal = numbers("PrincipalPointU", 1, "0")[0], numbers("PrincipalPointV", 1, "0")[0]
    return _camera(file.stem, (R, -R @ centre), focal, principal, k, size, str(file))


def _value(root: ElementTree.Element, name: str) -> str | None:
    """The text of a field, which is an attribute or an element."""
    for element in root.iter():
        if _XCR + name in element.attrib:
            return element.attrib[_XCR + name]
        if element.tag == _XCR + name:
            return element.text
    return None


def _size(name: str, index: PhotoIndex, sizes: Mapping[str, PhotoSize]) -> PhotoSize:
    """Size of the photo of a frame; any for one without a photo, whose camera is not used."""
    photo = index.match(name)
    return PhotoSize(1, 1) if photo is None else sizes[photo]


def _camera(
    name: str, pose: tuple[Array, Array], focal: float, principal: tuple[float, float], k: Sequence[float], size: PhotoSize, source: str
) -> Camera:
    """A camera from the focal length in mm, the principal point in shares of the longer side, and k1 … k4, t1, t2."""
    side = max(size.width, size.height)
    f = focal * side / SENSOR
    corner = math.hypot(size.width, size.height) / 2 / max(f, 1e-9)  # tangent of the angle to the corner
    refuse_coefficient("k4", k[3] * corner**9 * f, name, source)
    cx, cy = size.width / 2 + principal[0] * side, size.height / 2 + principal[1] * side
    distortion = k[0], k[1], k[5], k[4], k[2]
    return Camera(name, size.width, size.height, f, f, cx, cy, *pose, distortion if any(distortion) else ())
