"""Test models whose base colour has detail as fine as the pixels of large photos: print, grain, scratches, speckles and cracks.

Their textures have 4096² texels of about .001. Noise is read from a cube of random numbers, which takes less time than waves.
"""

from __future__ import annotations

import string

import cv2
import numpy as np
from scipy import ndimage

from benchmarks.objects.parts import Array, Material, step

#: Edge of the cube of random numbers; standard deviation of their trilinear mean at a random place.
CUBE, SPREAD = 64, (2 / 3) ** 1.5
#: Octaves of the grain, the cells of the finest one, and how much more each coarser one varies.
OCTAVES, FINEST, RISE = 6, 0.003, 1.2
#: Width and height of the printed sheet in pixels, and the height of the object in the model's own units that it covers.
SHEET, PRINTED = (6144, 2048), 1.6
#: Heights of the lines of print in pixels of the sheet.
HEIGHTS = (96, 28, 40, 20, 64, 14, 28, 48)


def lattice(points: Array, cell: float, seed: int) -> Array:
    """Noise (n,) of unit variance, trilinear in cells of edge `cell`, that repeats after CUBE cells."""
    cube = np.random.default_rng(seed).normal(size=(CUBE,) * 3)
    return np.asarray(ndimage.map_coordinates(cube, points.T / cell, order=1, mode="grid-wrap") / SPREAD)


def grain(points: Array, seed: int) -> Array:
    """Noise (n,) of unit variance with energy at all wavelengths down to a few texels."""
    weights = RISE ** np.arange(OCTAVES)
    octaves = (w * lattice(points, FINEST * 2.0**k, seed + k) for k, w in enumerate(weights))
    return np.asarray(sum(octaves) / np.linalg.norm(weights))


def curves(points: Array, cell: float, width: float, seed: int) -> Array:
    """Thin curves (n,), 1 on them, about `width` wide in units of the model: where noise passes through 0."""
    return 1 - step(np.abs(lattice(points, cell, seed)), width / cell, width / cell)


def sheet() -> Array:
    """A sheet of lines of characters, rules and a row of bars: share of ink (height, width)."""
    rng, (width, height) = np.random.default_rng(17), SHEET
    image, y, k = np.zeros((height, width), np.uint8), 20, 0
    while y + HEIGHTS[k % len(HEIGHTS)] + 60 < height:
        tall = HEIGHTS[k % len(HEIGHTS)]
        y += round(1.25 * tall)
        text = "".join(rng.choice(list(string.ascii_letters + string.digits + "   "), 4 * width // tall))
        cv2.putText(image, text, (0, y), cv2.FONT_HERSHEY_DUPLEX, tall / 22, 255, max(1, tall // 12), cv2.LINE_AA)
        y += round(0.45 * tall)
        if k % 4 == 3:
            bars = np.repeat(rng.random(width // 5) < 0.5, 5)
            image[y : y + 40, : len(bars)] = 255 * bars
            y += 56
        k += 1
    return np.asarray(image / 255.0)


def printed_material(p: Array) -> Material:
    """Diffuse card: fibres, dark print all around, scratches that show the paper below."""
    n, (width, height) = len(p), SHEET
    card = Material.uniform(n, (0.56, 0.47, 0.34), 0.85).shaded(1 + 0.16 * grain(p, 40))
    across = (np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi) + 0.5) * (width - 1)
    down = (0.5 - p[:, 2] / PRINTED) * (height - 1)
    ink = ndimage.map_coordinates(sheet(), [down, across], order=1, mode="constant")
    black, red = Material.uniform(n, (0.03, 0.035, 0.06), 0.85), Material.uniform(n, (0.30, 0.02, 0.02), 0.85)
    tone = black.blend(red, step(lattice(p, 0.5, 4), 0.4, 0.02))
    worn = 0.9 * curves(p, 0.2, 0.003, 21)
    return card.blend(tone, ink * (1 - worn)).blend(Material.uniform(n, (0.80, 0.78, 0.74), 0.85), 0.6 * worn)


def stoneware_material(p: Array) -> Material:
    """Slightly glossy glaze: speckles of iron of several sizes, fine dark cracks, rings of brush marks."""
    n = len(p)
    glaze = Material.uniform(n, (0.42, 0.52, 0.50), 0.32).shaded(1 + 0.12 * grain(p, 60))
    ring = step(np.sin(26 * p[:, 2]) + 0.35 * lattice(p * [1, 1, 30], 0.2, 3), 0.5, 0.08)
    glaze = glaze.blend(Material.uniform(n, (0.10, 0.16, 0.30), 0.32).shaded(1 + 0.2 * grain(p, 80)), ring)
    for cell, seed in ((0.03, 7), (0.012, 8), (0.005, 9)):
        glaze = glaze.blend(Material.uniform(n, (0.09, 0.05, 0.03), 0.36), step(lattice(p, cell, seed), 2.0, 0.4))
    return glaze.blend(Material.uniform(n, (0.12, 0.10, 0.08), 0.4), 0.8 * curves(p, 0.12, 0.003, 31))
