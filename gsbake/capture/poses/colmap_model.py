"""COLMAP sparse models (binary and text), read and written through pycolmap.

COLMAP's cameras are world→camera with OpenCV axes and pixel centres at +.5, as here. See https://colmap.github.io/format.html.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.poses.colmap_binary import BINARY_FILES, check_binary_files
from gsbake.capture.poses.frames import GivenPoses, PhotoSize, checked_rigid, match_cameras
from gsbake.capture.poses.validation import MAX_COORDINATE
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.limited_process import ParserProcess, read_in_child
from gsbake.memory_budget import check, child_limit
from gsbake.text import missing_list

#: Files of a model.
FILES = (*BINARY_FILES, *(name.replace(".bin", ".txt") for name in BINARY_FILES))
#: Files that a binary model has, and a text model; rigs and frames came with COLMAP 4.
NEEDED = ("cameras.bin", "images.bin", "points3D.bin")
TEXT_FILES = ("cameras.txt", "images.txt", "points3D.txt")
#: Camera model → index of each of fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6 in COLMAP's parameters, as far as the model has them.
_LAYOUT = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11),
}

#: Memory of the process that reads a model: of the libraries, and per byte of the model. Seconds it may take.
SPARE_MEMORY, MEMORY_FACTOR, READER_SECONDS = 2 << 30, 16, 600.0


def intrinsics(model: str, params: Any, where: str) -> dict[str, Any]:
    """fx, fy, cx, cy and OpenCV distortion of a COLMAP camera; raises BadInputError for models that are not perspective."""
    if model not in _LAYOUT:
        raise BadInputError(f"The camera model {model} in {where} is not supported; undistort the photos first (colmap image_undistorter).")
    values = [float(params[i]) for i in _LAYOUT[model]]
    fx, fy, cx, cy, *k = values
    distortion = tuple(k + [0.0] * (4 - len(k))) if any(k) else ()
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": distortion}


def camera_of(image: Any, name: str, where: str) -> Camera:
    """The `Camera` of a registered image of a pycolmap reconstruction."""
    pose, lens = image.cam_from_world(), image.camera
    return _camera(name, pose.rotation.matrix(), pose.translation, (lens.width, lens.height), lens.model_name, lens.params, where)


def _camera(name: str, rotation: Any, translation: Any, size: tuple[int, int], model: str, params: Any, where: str) -> Camera:
    rot, t = checked_rigid(np.asarray(rotation, float), np.asarray(translation, float), name, where)
    return Camera(name=name, width=size[0], height=size[1], R=rot, t=t, **intrinsics(model, params, where))


def read_model(folder: Path, sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """Poses and points of an untrusted COLMAP model folder, read in a child process with limited memory and time.

    Raises BadInputError for damaged files, values that are not finite or out of bounds, and camera models that are not perspective.
    """
    with model_reader() as reader:
        return read_model_with(reader, folder, sizes)


def model_reader() -> ParserProcess:
    """The process that reads models."""
    return ParserProcess("gsbake.capture.poses.colmap_reader")


def read_model_with(reader: ParserProcess, folder: Path, sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """`read_model` through a running `model_reader`."""
    name = f"The COLMAP model {folder}"
    needed = MEMORY_FACTOR * sum((folder / file).stat().st_size for file in FILES if (folder / file).is_file())
    check(needed, name)  # by the size that the files state: a sparse one of a terabyte is as long to read
    _check_files(folder, name)
    check_binary_files(folder)
    with tempfile.TemporaryDirectory(prefix="gsbake-colmap-") as scratch:
        target = Path(scratch) / "model.npz"
        request = {"folder": str(folder), "target": str(target), "memory": child_limit(needed, SPARE_MEMORY)}
        listed = read_in_child(reader, request, READER_SECONDS, name)
        with np.load(target, allow_pickle=False) as body:
            arrays = {name: body[name] for name in body.files}
    frames = []
    for k, (name, model) in enumerate(zip(listed["names"], listed["models"], strict=True)):
        width, height = (int(x) for x in arrays["sizes"][k])
        pose = arrays["rotations"][k], arrays["translations"][k]
        frames.append((name, _camera(name, *pose, (width, height), model, arrays["params"][k], str(folder))))
    if not frames:
        raise BadInputError(f"The COLMAP model {folder} holds no image with a pose.")
    cameras, missing = match_cameras(frames, sizes, str(folder))
    near = (np.abs(arrays["points"]) < MAX_COORDINATE).all(1)
    points, colours = arrays["points"][near], arrays["colours"][near]
    return GivenPoses(cameras, missing, points if len(points) else None, colours if len(points) else None)


def _check_files(folder: Path, name: str) -> None:
    """Raise BadInputError where a model is complete neither in binary nor in text."""
    absent = [[file for file in kind if not (folder / file).is_file()] for kind in (NEEDED, TEXT_FILES)]
    if all(absent):
        raise BadInputError(f"{name} cannot be read (it lacks {missing_list(min(absent, key=len))}); export it again.")


def read_tracks(folder: Path) -> tuple[Any, dict[str, NDArray[np.int64]]]:
    """Points (n, 3) of a COLMAP model folder in its own frame, and the indices of the points that each photo shows, by the photo's name
    without suffix. Raises BadInputError for damaged files."""
    model = _open(folder)
    index = {name: k for k, name in enumerate(model.points3D)}
    points = np.array([p.xyz for p in model.points3D.values()], float).reshape(-1, 3)
    visible = {
        Path(image.name).stem: np.array([index[p.point3D_id] for p in image.points2D if p.has_point3D()], np.int64)
        for image in model.images.values()
    }
    return points, visible


def _open(folder: Path) -> Any:
    from gsbake.capture.colmap import pycolmap

    try:
        return pycolmap.Reconstruction(str(folder))
    except (ValueError, RuntimeError, OSError, IndexError) as error:
        reason = str(error).strip().splitlines()[-1]
        raise BadInputError(f"The COLMAP model {folder} cannot be read ({reason}).") from error


def cloud(model: Any) -> tuple[Any, Any]:
    """Points (n, 3) of a reconstruction and their colours (n, 3) 8-bit, without points that are not finite."""
    entries = list(model.points3D.values())
    points = np.array([p.xyz for p in entries], float).reshape(-1, 3)
    colours = np.array([p.color for p in entries], np.uint8).reshape(-1, 3)
    finite = np.isfinite(points).all(1)
    return points[finite], colours[finite]
