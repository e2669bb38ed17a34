"""Lenses: which photos share one, and which are plausible.

Photos share intrinsics that are of one camera at one focal length and size, or that were given equal. Two bodies of one model differ in
lenses and sensors; the serial number in EXIF tells them apart. Where EXIF names a model without one (telephones), photos of each sub-folder
are taken for those of one body, unless they are too few to calibrate it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from gsbake.capture.photos.undistortion import distort, intrinsics_key, pinhole_camera
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera

#: Photos in each of several sub-folders from which each folder has a camera of its own.
MIN_FOLDER_PHOTOS = 12
#: Largest shift that a lens's distortion plausibly causes at the corner of a photo, as a share of the corner's distance from the centre;
#: wide-angle lenses reach a quarter.
MAX_DISTORTION = 0.35


def _folder(entry: dict[str, Any]) -> str:
    """Sub-folder of a photo whose EXIF names a model without a serial number; empty for others."""
    known = entry["camera_model"] and not entry.get("camera_body")
    return str(entry["source"]).rpartition("/")[0] if known else ""


def solved_lenses(entries: Sequence[dict[str, Any]]) -> tuple[list[dict[str, Any]], str]:
    """Photos grouped by shared intrinsics, for the job of structure from motion, and what sub-folders decided (empty: nothing).

    `entries` are those of photos.json.
    """
    folders = Counter(folder for entry in entries if (folder := _folder(entry)))
    by_folder = len(folders) > 1 and min(folders.values()) >= MIN_FOLDER_PHOTOS
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for entry in entries:
        body = entry.get("camera_body") or (_folder(entry) if by_folder else "")
        groups.setdefault((entry["width"], entry["height"], entry["camera_model"], body), []).append(entry)
    lenses = []
    for (width, height, *_), members in groups.items():
        focals = sorted(e["focal_px"] for e in members if e["focal_px"])
        focal = focals[len(focals) // 2] if focals else None
        lenses.append({"names": [e["name"] for e in members], "width": width, "height": height, "focal": focal})
    return lenses, f"one for each of {len(folders)} sub-folders, because EXIF has no serial numbers" if by_folder else ""


def given_lenses(cameras: Sequence[Camera]) -> list[dict[str, Any]]:
    """Photos grouped by their given intrinsics, for the job of triangulation."""
    groups: dict[tuple[float, ...], list[Camera]] = {}
    for camera in cameras:
        groups.setdefault(intrinsics_key(camera), []).append(camera)
    return [
        {"names": [c.name for c in members], "width": members[0].width, "height": members[0].height, "focal": None}
        for members in groups.values()
    ]


def is_plausible_lens(camera: Camera) -> bool:
    """Whether a lens may have the distortion of `camera`.

    Photos that show two things that move against each other, such as an object on a turntable and the room, have no common cameras; what is
    left of the contradiction ends up in the distortion.
    """
    corner = np.array([camera.width / 2 / camera.fx, camera.height / 2 / camera.fy])
    try:
        pinhole_camera(camera)
    except BadInputError:
        return False
    moved = distort(corner, camera.distortion or (0.0,))
    return bool(np.linalg.norm(moved - corner) <= MAX_DISTORTION * np.linalg.norm(corner))
