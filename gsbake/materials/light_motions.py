"""The ways in which the light may move, between which the material fit decides: what cameras and EXIF say of a turntable and of a flash."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.turntable import Turntable, find_turntable
from gsbake.materials.starts import MOTIONS
from gsbake.monitor import Monitor
from gsbake.shading.light_motion import LightMotion, Motion, light_rotations

Doubles = NDArray[np.float64]

#: Share of the cameras that must stand on exact circles for the light to turn (.97 on a turntable, 0 on captures from hand).
MIN_TURNTABLE_SHARE = 0.5


def light_motions(cameras: Sequence[Camera], asked: str, monitor: Monitor) -> tuple[LightMotion, dict[Motion, Doubles | None]]:
    """How the light moves as it is `asked` for (`bake.light_motion`), and where that is auto, between which motions validation photos
    decide."""
    if asked == "auto":
        return LightMotion(), _possible(cameras, monitor)
    motion: Motion = "turntable" if asked == "turntable" else "camera" if asked == "camera" else "static"
    rotations = light_rotations(cameras, motion)
    if rotations is None and motion != "static":
        monitor.warn(f"bake.light_motion is {asked}, but the cameras stand on no circles about an axis; the light is taken to stand.")
        motion = "static"
    monitor.decide("light", MOTIONS[motion], "bake.light_motion")
    return LightMotion(motion, rotations), {}


def _possible(cameras: Sequence[Camera], monitor: Monitor) -> dict[Motion, Doubles | None]:
    """Motions that cameras and flash allow, with their rotations."""
    found: dict[Motion, Doubles | None] = {"static": None}
    table = find_turntable(cameras)
    if table is not None and table.share >= MIN_TURNTABLE_SHARE:
        found["turntable"] = light_rotations(cameras, "turntable", table)
        monitor.decide("turntable", _positions(table), f"{table.share:.0%} of the cameras stand on exact circles")
    else:  # photos of a plain round object fit a light that turns too, by their noise
        share = 0.0 if table is None else table.share
        monitor.decide("turntable", "none", f"{share:.0%} of the cameras stand on exact circles; {MIN_TURNTABLE_SHARE:.0%} are needed")
    if all(camera.flash is False for camera in cameras):
        monitor.decide("flash", "none", f"EXIF says of all {len(cameras)} photos that it did not fire")
    elif (rotations := light_rotations(cameras, "camera")) is not None:
        found["camera"] = rotations
    return found


def _positions(table: Turntable) -> str:
    """How often the object was laid down differently, in words."""
    counts = " and ".join(map(str, table.counts))
    return (
        "one position of the object" if len(table.axes) == 1 else f"one light, {len(table.axes)} positions of the object ({counts} photos)"
    )
