"""Cameras exported by Agisoft Metashape (PhotoScan) as XML: *Metashape User Manual*, appendix "Camera models".

A point (X, Y, Z) of a camera's frame (x right, y down, z forward) with x = X/Z, y = Y/Z, r² = x² + y² is seen at

    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2x²) + 2 p2 xy
    y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p2 (r² + 2y²) + 2 p1 xy
    u = w/2 + cx + x' (f + b1) + y' b2,    v = h/2 + cy + y' f

which is OpenCV's model with p1 and p2 exchanged. Files up to version 1.1 have fx, fy and the principal point from the corner instead. The
matrix of a camera leads from its frame to that of its chunk; cameras without one are not aligned. A fourth radial coefficient, skew b2, and
fisheye or spherical cameras are refused: Metashape's *Undistort Photos* removes them. Where the chunk has a scale, coordinates are
multiplied by it (metres, where scale bars were set). The chunk's region, a box in its frame, is read too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from gsbake.capture.poses.frames import GivenPoses, PhotoSize, checked_rigid, match_cameras
from gsbake.capture.poses.validation import MAX_FRAMES, read_xml, refuse_coefficient
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.geometry.region import Region
from gsbake.text import missing_list


def read_metashape(path: Path, sizes: Mapping[str, PhotoSize]) -> GivenPoses:
    """Poses of a cameras XML for the photos in `sizes`.

    Raises BadInputError for an invalid file, a value that is not finite or out of bounds, a matrix that is no rigid motion, and for camera
    models that are not supported.
    """
    document = _parse(path)
    try:
        sensors = {sensor.get("id", ""): sensor for sensor in document.iter("sensor")}
        scale = float(document.findtext("chunk/transform/scale", "1"))
        if not (math.isfinite(scale) and scale > 0):
            raise BadInputError(f"The scale of the chunk in {path} is {scale}; export the cameras again.")
        aligned = [entry for entry in document.iter("camera") if entry.findtext("transform") is not None and entry.get("label")]
        if len(aligned) > MAX_FRAMES:
            raise BadInputError(f"{path} has more than {MAX_FRAMES} cameras.")
        lacking = [f"{entry.get('label')}: {what}" for entry in aligned if (what := _absent(sensors.get(entry.get("sensor_id", ""))))]
        if lacking:
            raise BadInputError(f"Cameras in {path} lack fields ({missing_list(lacking)}); export the cameras after alignment.")
        frames: list[tuple[str, Camera]] = []
        for entry in aligned:
            matrix, name = entry.findtext("transform", ""), entry.get("label", "")
            pose = np.array(matrix.split(), float).reshape(4, 4)
            rotation, centre = checked_rigid(pose[:3, :3], scale * pose[:3, 3], name, str(path))
            inner = _intrinsics(sensors[entry.get("sensor_id", "")], name, path)
            frames.append((name, Camera(name=name, R=rotation.T, t=-rotation.T @ centre, **inner)))
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        reason = " ".join(repr(error).split())[:200]
        raise BadInputError(f"{path} is not a valid file of Metashape cameras ({reason}); export the cameras again.") from error
    if not frames:
        raise BadInputError(f"{path} holds no aligned camera; align the photos in Metashape and export the cameras as Agisoft XML.")
    cameras, missing = match_cameras(frames, sizes, str(path))
    try:
        return GivenPoses(cameras, missing, region=_region(document, scale, path))
    except BadInputError as error:
        return GivenPoses(cameras, missing, warnings=(f"{error} No region is used.",))


def _parse(path: Path) -> ElementTree.Element:
    document = read_xml(path, "file of Metashape cameras")
    if document.tag != "document" or document.find("chunk") is None:
        raise BadInputError(f"{path} is no file of Metashape cameras; export the cameras as Agisoft XML.")
    return document


def _region(document: ElementTree.Element, scale: float, path: Path) -> Region | None:
    """The box of the chunk's region; None without one. Raises BadInputError for one that is no box."""
    found = document.find("chunk/region")
    if found is None:
        return None
    try:
        parts = [np.array(found.findtext(name, "").split(), float) for name in ("center", "size", "R")]
    except ValueError as error:
        raise BadInputError(f"The region in {path} holds other things than numbers.") from error
    if [len(part) for part in parts] != [3, 3, 9]:
        raise BadInputError(f"The region in {path} is not a centre, a size and a rotation.")
    return Region.of(np.concatenate([scale * parts[0], scale * parts[1], parts[2]]).tolist(), str(path))


def _absent(sensor: ElementTree.Element | None) -> str:
    """What a sensor lacks: itself, its calibration or its resolution; empty where nothing."""
    if sensor is None:
        return "sensor"
    if sensor.find("calibration") is None:
        return "calibration"
    return "resolution" if sensor.find("calibration/resolution") is None and sensor.find("resolution") is None else ""


def _intrinsics(sensor: ElementTree.Element, name: str, path: Path) -> dict[str, Any]:
    """Size, focal lengths, principal point and distortion of a camera with this sensor, which lacks nothing."""
    found = sensor.findall("calibration")
    calibration = next((c for c in found if c.get("class") == "adjusted"), found[0])
    kind = calibration.get("type", sensor.get("type", "frame"))
    if kind != "frame":
        raise BadInputError(f"The camera of frame {name} in {path} is of the type {kind}, not frame; undistort the photos first.")
    resolution = next(r for where in (calibration, sensor, *found) if (r := where.find("resolution")) is not None)
    width, height = int(resolution.get("width", "")), int(resolution.get("height", ""))
    value = {child.tag: float(child.text or "") for child in calibration if child.tag != "resolution" and len(child) == 0}
    if "f" in value:
        fx, fy = value["f"] + value.get("b1", 0.0), value["f"]
        cx, cy = width / 2 + value.get("cx", 0.0), height / 2 + value.get("cy", 0.0)
    else:
        fx, fy, cx, cy = value["fx"], value["fy"], value.get("cx", width / 2), value.get("cy", height / 2)
    corner = math.hypot(width, height) / 2 / max(min(fx, fy), 1e-9)  # tangent of the angle to the corner
    skew = value.get("b2", value.get("skew", 0.0))
    refuse_coefficient("k4", value.get("k4", 0.0) * corner**9 * fx, name, str(path))
    refuse_coefficient("b2", skew * corner, name, str(path))
    k = tuple(value.get(key, 0.0) for key in ("k1", "k2", "p2", "p1", "k3"))
    return {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": k if any(k) else ()}
