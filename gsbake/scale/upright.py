"""The up axis of an asset by points that the user gave, or by what lies level in the photos: printed markers, or the ground that the object
stands on. Its front by a photo.

Without them up is that of the cameras, which are rarely held level to a degree (`capture.poses.up_axis`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.capture.poses.up_axis import upright_rotation
from gsbake.config.schema import Export, Scale
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, Camera, CameraSet
from gsbake.geometry.vectors import unit
from gsbake.monitor import SILENT, Monitor
from gsbake.scale.markers import Marker, find_markers

#: Largest angle in degrees between the normals of markers that lie on one plane.
MAX_MARKER_ANGLE = 15.0
#: Markers lie in one plane when their corners do to this share of a side: the plane is then fitted to all corners.
MAX_HEIGHT_SHARE = 0.1
#: Sine of the angle between a camera's direction and up below which they determine no front.
MIN_SINE = 0.02
#: Changes below this angle in degrees are not reported as a tilt.
LEVEL = 0.05


def measure_rotation(ingest: Path, posed: PosedPhotos, surfels: Path, export: Export, scale: Scale, *, monitor: Monitor = SILENT) -> Array:
    """The rotation (3, 3) of the world, Z-up by the cameras, that makes the given points, markers or the ground level; the unit matrix with
    a warning where there are none, or for `export.up` = "cameras".

    `ingest` and `surfels` are artifact folders of the working photos and of the surfels, `scale` names the markers' dictionary.
    """
    up: str = export.up
    axis: Array | None
    if export.up_points:
        up = "points"
        centres = posed.cameras.to_world.apply(np.stack([camera.centre for camera in posed.cameras.cameras]))
        axis, evidence = points_axis(np.reshape(export.up_points, (-1, 3)), centres)
    elif up == "cameras":
        return np.eye(3)
    elif up == "markers":
        cameras = CameraSet.load(posed.folder / "photo_cameras.json").cameras
        dictionary, markers = find_markers(cameras, ingest / "photos", scale.marker_dictionary)
        axis, evidence = marker_axis(markers)
        evidence = f"{dictionary}, {evidence}" if markers else evidence
    else:
        axis, evidence = _ground_axis(posed, surfels)
    if axis is None:
        monitor.warn(f"export.up = {up}: {evidence}; up is that of the cameras.")
        return np.eye(3)
    tilt = float(np.degrees(np.arccos(np.clip(axis[2], -1, 1))))
    monitor.decide("up axis", f"{up}, {tilt:.1f}° off that of the cameras" if tilt > LEVEL else f"{up}, as that of the cameras", evidence)
    return upright_rotation(axis)


def points_axis(points: Array, centres: Array) -> tuple[Array, str]:
    """The up axis (3,) by the lower and upper end of an upright edge (2, 3), or by three points of the ground (3, 3), towards the cameras'
    `centres` (n, 3); and the evidence. The settings take no points that determine none.
    """
    sides = points[1:] - points[0]
    normal = sides[0] if len(sides) == 1 else np.cross(sides[0], sides[1])
    if len(sides) == 1:
        return np.asarray(unit(normal)), "an upright edge"
    above = float((centres.mean(0) - points[0]) @ normal)
    return np.asarray(unit(normal) * (1.0 if above >= 0 else -1.0)), "three points of the ground"


def front_rotation(camera: Camera, centre: Array) -> Array:
    """The rotation (3, 3) about Z of a Z-up world that turns the direction from `centre` (3,) to a camera to −Y, the asset's front.

    Raises BadInputError for a camera straight above or below.
    """
    towards = camera.centre - centre
    if np.hypot(towards[0], towards[1]) < MIN_SINE * np.linalg.norm(towards):
        raise BadInputError(f"The photo {camera.name} looks from straight above or below; name another for export.front.")
    turn = -np.pi / 2 - np.arctan2(towards[1], towards[0])
    sine, cosine = np.sin(turn), np.cos(turn)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def marker_axis(markers: Sequence[Marker]) -> tuple[Array | None, str]:
    """The common unit normal (3,) of the markers, out of their printed side, and the evidence; None where they have none."""
    if not markers:
        return None, "no printed marker is seen in three photos or more"
    # Corners run clockwise from the top left, so the product of the diagonals comes out of the paper.
    corners = np.stack([marker.corners for marker in markers])
    normals = unit(np.cross(corners[:, 2] - corners[:, 0], corners[:, 1] - corners[:, 3]))
    axis = unit(normals.sum(0))
    angle = float(np.degrees(np.arccos(np.clip(normals @ axis, -1, 1))).max())
    if angle > MAX_MARKER_ANGLE:
        return None, f"the markers do not lie on one plane (up to {angle:.0f}° off)"
    points = corners.reshape(-1, 3)
    offset = points - points.mean(0)
    fitted = np.linalg.svd(offset, full_matrices=False)[2][2]
    side = float(np.mean([marker.sides.mean() for marker in markers]))
    if np.abs(offset @ fitted).max() < MAX_HEIGHT_SHARE * side:
        axis = fitted * np.sign(fitted @ axis)
    return np.asarray(axis), f"{len(markers)} markers, normals within {angle:.1f}°"


def _ground_axis(posed: PosedPhotos, surfels: Path) -> tuple[Array | None, str]:
    """The normal (3,) of the plane that the object stands on, in the world, and the evidence; None where there is none."""
    from gsbake.meshing.support_plane import find_support_plane
    from gsbake.surfels.model import Surfels
    from gsbake.surfels.oriented_points import oriented_points

    if posed.has_masks:
        return None, "the photos have masks, so the ground was not reconstructed"
    samples = oriented_points(Surfels.load(surfels / "surfels.safetensors"))
    centres = np.stack([camera.centre for camera in posed.cameras.cameras])
    plane, evidence = find_support_plane(samples.points, samples.normals, samples.weights, centres, seed=0)
    return None if plane is None else np.asarray(posed.cameras.to_world.rotation @ plane.normal), evidence
