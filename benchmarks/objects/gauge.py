"""Test model of a pressure gauge: a printed glossy dial set back behind a metal rim, a needle before it, and no glass."""

from __future__ import annotations

import cv2
import numpy as np
import trimesh
from scipy import ndimage

from benchmarks.objects.parts import BRASS, STEEL, Array, Material, bar, joined, turned
from gsbake.imaging.srgb import decode

#: From the gauge's own frame (dial in the xy plane, seen from +z) to that of the models: it looks up by 35°.
LOOKS_UP = np.radians(35)
ROTATION = np.array([[1, 0, 0], [0, np.sin(LOOKS_UP), -np.cos(LOOKS_UP)], [0, np.cos(LOOKS_UP), np.sin(LOOKS_UP)]])
#: Depth of the dial, front of the rim, radius of the dial and of the case.
DIAL, RIM, DIAL_RADIUS, CASE = 0.29, 0.42, 0.57, 0.60
#: Edge of the print in pixels; degrees of the scale, clockwise from its zero.
PRINT, SCALE = 1024, (225.0, -45.0)
NEEDLE = np.radians(75)


def gauge() -> trimesh.Trimesh:
    """Case with rim and dial, needle with hub, and a threaded stem below."""
    case = turned([
        (0, 0, 0), (CASE - 0.04, 0, 0.04), (CASE, 0.30, 0.01), (0.68, 0.30, 0.015), (0.68, RIM, 0.04), (0.60, RIM, 0.015),
        (DIAL_RADIUS, DIAL, 0.005), (0, DIAL, 0),
    ])  # fmt: skip
    hub = turned([(0, DIAL - 0.01, 0), (0.045, DIAL - 0.01, 0), (0.045, DIAL + 0.05, 0.008), (0, DIAL + 0.05, 0)], sections=48)
    along = np.array([np.cos(NEEDLE), np.sin(NEEDLE), 0])
    path = np.linspace(-0.14, 0.42, 12)[:, None] * along + [0, 0, DIAL + 0.03]
    needle = bar(path, np.array([0.0, 0.0, 1.0]), (0.014, 0.006), sections=16)
    stem = turned([(0, 0, 0), (0.09, 0, 0.02), (0.09, 0.24, 0.01), (0.13, 0.26, 0.02), (0.13, 0.52, 0), (0, 0.52, 0)])
    stem.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    parts = joined([case, hub, needle, stem.apply_translation([0, -1.08, 0.15])])
    turn = np.eye(4)
    turn[:3, :3] = ROTATION
    return parts.apply_transform(turn)


def dial_print() -> Array:
    """What is printed on the dial: linear RGB (PRINT, PRINT, 3), as seen from the front, the dial from edge to edge."""
    image = np.full((PRINT, PRINT, 3), (236, 233, 224), np.uint8)
    black, red, centre = (24, 24, 26), (168, 22, 18), 0.5 * PRINT

    def at(radius: float, degrees: float) -> tuple[int, int]:
        """Position in 1/16 pixels, for OpenCV's shift of 4."""
        angle = np.radians(degrees)
        return round(16 * centre * (1 + radius * np.cos(angle))), round(16 * centre * (1 - radius * np.sin(angle)))

    middle, (zero, full) = (round(centre), round(centre)), SCALE
    warning = zero + 0.8 * (full - zero)
    cv2.ellipse(image, middle, (round(0.78 * centre),) * 2, 0, -warning, -full, red, 34, cv2.LINE_AA)
    cv2.ellipse(image, middle, (round(0.86 * centre),) * 2, 0, -zero, -full, black, 6, cv2.LINE_AA)
    for k in range(51):
        degrees, long = zero + k / 50 * (full - zero), k % 5 == 0
        cv2.line(image, at(0.70 if long else 0.79, degrees), at(0.86, degrees), black, 9 if long else 4, cv2.LINE_AA, 4)
        if k % 10 == 0:
            text = str(k // 5)
            (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 3.0, 7)
            x, y = (c / 16 for c in at(0.55, degrees))
            cv2.putText(image, text, (round(x - width / 2), round(y + height / 2)), cv2.FONT_HERSHEY_DUPLEX, 3.0, black, 7, cv2.LINE_AA)
    for text, size, down in (("bar", 2.0, 0.36), ("CL 1.6", 1.0, 0.52)):
        (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, size, 3)
        cv2.putText(
            image, text, (round(centre - width / 2), round(centre * (1 + down))), cv2.FONT_HERSHEY_DUPLEX, size, black, 3, cv2.LINE_AA
        )
    return np.asarray(decode(image / 255.0))


def gauge_material(p: Array) -> Material:
    """Black lacquer, bright steel rim, brass stem, black needle, glossy printed dial."""
    n, own = len(p), p @ ROTATION
    radius, depth = np.hypot(own[:, 0], own[:, 1]), own[:, 2]
    material = Material.uniform(n, (0.02, 0.02, 0.022), 0.3)
    rim = (radius > DIAL_RADIUS - 0.001) & (depth > DIAL + 0.001) & ((radius > CASE + 0.002) | (depth > 0.305))
    material = material.blend(Material.uniform(n, STEEL, 0.16, 1.0), rim.astype(float))
    material = material.blend(Material.uniform(n, BRASS, 0.28, 1.0), (own[:, 1] < -CASE - 0.001).astype(float) * (radius > 0.69))
    dial = (np.abs(depth - DIAL) < 0.003) & (radius < DIAL_RADIUS)
    x, y = ((0.5 + s * own[:, k] / (2 * DIAL_RADIUS)) * PRINT - 0.5 for k, s in ((0, 1), (1, -1)))
    colour = np.column_stack(
        [ndimage.map_coordinates(channel, [y, x], order=1, mode="nearest") for channel in dial_print().transpose(2, 0, 1)]
    )
    printed = Material(colour, np.full(n, 0.12), np.zeros(n), np.zeros((n, 3)))
    return material.blend(printed, dial.astype(float))
