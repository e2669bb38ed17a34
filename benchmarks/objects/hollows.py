"""Test models with hollows: a mug, a deep bowl, a flower pot, an open box and a shoe. Inside and out, a glaze has no texture."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from benchmarks.objects.parts import Array, Material, bar, joined, noise, panels, ring_surface, step, turned

#: Half the width and depth of the box outside, its height, and the thickness of its walls.
BOX, WALL = (0.62, 0.42, 0.5), 0.035
#: Outside of the shoe from the sole up: height, centre and half length along x, half width; the welt is the sixth row.
SHOE = (
    (0.00, 0.0, 0.96, 0.32), (0.02, 0.0, 1.0, 0.35), (0.07, 0.0, 1.0, 0.35), (0.12, 0.0, 1.0, 0.35), (0.14, 0.0, 0.98, 0.335),
    (0.15, 0.0, 0.955, 0.32), (0.20, 0.0, 0.95, 0.33), (0.30, -0.03, 0.91, 0.335), (0.38, -0.13, 0.80, 0.33), (0.45, -0.26, 0.66, 0.315),
    (0.54, -0.40, 0.52, 0.29), (0.66, -0.50, 0.43, 0.255), (0.80, -0.545, 0.40, 0.235), (0.92, -0.555, 0.395, 0.23),
)  # fmt: skip
SOLE, LINING = 0.145, 0.035


def mug() -> trimesh.Trimesh:
    """A cylinder with a handle."""
    body = turned([
        (0, 0.02, 0), (0.32, 0.02, 0.01), (0.34, 0, 0.01), (0.42, 0, 0.06), (0.42, 0.95, 0.02), (0.375, 0.95, 0.02), (0.375, 0.05, 0.1),
        (0, 0.05, 0),
    ])  # fmt: skip
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 40)
    bow = np.column_stack([0.5 + 0.2 * np.cos(turn), 0 * turn, 0.48 + 0.25 * np.sin(turn)])
    ends = [(0.397, 0, 0.23), (0.43, 0, 0.23)], [(0.43, 0, 0.73), (0.397, 0, 0.73)]
    return joined([body, bar(np.concatenate([ends[0], bow, ends[1]]), np.array([0.0, 1.0, 0.0]), (0.035, 0.055))])


def bowl() -> trimesh.Trimesh:
    """A bowl on a foot, nearly as deep as wide is its half."""
    return turned([
        (0, 0.02, 0), (0.24, 0.02, 0.01), (0.26, 0, 0.01), (0.30, 0, 0.01), (0.30, 0.06, 0.02), (0.62, 0.08, 0.36), (0.74, 0.72, 0.01),
        (0.71, 0.725, 0.01), (0.59, 0.10, 0.38), (0, 0.10, 0),
    ], segments=16)  # fmt: skip


def flower_pot() -> trimesh.Trimesh:
    """A tapered pot with a collar."""
    return turned([
        (0, 0, 0), (0.36, 0, 0.03), (0.483, 0.7, 0.015), (0.55, 0.7, 0.02), (0.575, 0.95, 0.025), (0.51, 0.95, 0.025), (0.49, 0.72, 0.02),
        (0.44, 0.72, 0.02), (0.32, 0.05, 0.05), (0, 0.05, 0),
    ])  # fmt: skip


def box() -> trimesh.Trimesh:
    """A box without a lid."""
    x, y, z = BOX
    outer, inner = [(x, y), (-x, y), (-x, -y), (x, -y)], [(s * (x - WALL), t * (y - WALL)) for s, t in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    quads = [[(*p, 0.0) for p in reversed(outer)], [(*p, WALL) for p in inner]]
    for k in range(4):
        a, b, c, d = outer[k], outer[k - 3], inner[k - 3], inner[k]
        quads += [[(*a, 0), (*b, 0), (*b, z), (*a, z)], [(*a, z), (*b, z), (*c, z), (*d, z)], [(*d, z), (*c, z), (*c, WALL), (*d, WALL)]]
    return panels(quads)


def shoe_rings(levels: Array, around: int = 128, dense: int = 6) -> Array:
    """Rings (m, around, 3) through `levels` (height, centre, half length, half width), with `dense` ones between two (Catmull-Rom).

    Soles are narrow at the waist and the heel and curved to one side; towards the top a ring becomes a plain oval.
    """
    padded = np.concatenate([levels[:1], levels, levels[-1:]])
    t = np.linspace(0, 1, dense, endpoint=False)[:, None]
    parts = [
        b + 0.5 * ((c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(padded[:-3], padded[1:-2], padded[2:-1], padded[3:], strict=True)
    ]
    height, centre, length, width = np.concatenate([*parts, levels[-1:]])[:, :, None].transpose(1, 0, 2)
    turn = np.linspace(0, 2 * np.pi, around, endpoint=False)
    u, v = (np.sign(f(turn)) * np.abs(f(turn)) ** 0.85 for f in (np.cos, np.sin))
    sole = np.clip((0.5 - height) / 0.35, 0, 1)
    waist = 1 - sole * (0.14 * (1 - step(u, 0.1, 1.2)) + 0.14 * np.exp(-(((u + 0.1) / 0.35) ** 2)))
    return np.stack([centre + length * u, width * (waist * v + 0.2 * sole * (u**2 - 0.4)), np.broadcast_to(height, waist.shape)], 2)


def shoe() -> trimesh.Trimesh:
    """A shoe with an opening that narrows towards the toe."""
    outside = np.array(SHOE)
    inside = outside[:5:-1] - [LINING - 0.005, 0, LINING - 0.005, LINING]
    rim = 0.5 * (outside[-1:] + inside[:1]) + [0.02, 0, 0, 0]
    ends = np.array([[0, 0, 0, 0]]), np.array([[inside[-1, 0], 0, 0, 0]])
    return ring_surface(np.concatenate([shoe_rings(level) for level in (np.concatenate([ends[0], outside[:1]]), outside,
        np.concatenate([outside[-1:], rim, inside[:1]]), inside, np.concatenate([inside[-1:], ends[1]]))]))  # fmt: skip


def mug_material(p: Array) -> Material:
    """Grey-green glaze."""
    return Material.uniform(len(p), (0.42, 0.50, 0.44), 0.12)


def bowl_material(p: Array) -> Material:
    """Blue-grey glaze, a bare clay foot."""
    glaze, clay = Material.uniform(len(p), (0.24, 0.33, 0.42), 0.16), Material.uniform(len(p), (0.45, 0.30, 0.20), 0.8)
    return glaze.blend(clay, step(-p[:, 2], -0.03, 0.01))


def terracotta_material(p: Array) -> Material:
    """Terracotta with lime stains."""
    clay = Material.uniform(len(p), (0.46, 0.19, 0.10), 0.85).shaded(1 + 0.08 * noise(p, 20, 3) + 0.05 * noise(p, 70, 4))
    lime = Material.uniform(len(p), (0.62, 0.56, 0.50), 0.9)
    return clay.blend(lime, 0.6 * step(noise(p, 5, 5) + 0.3 * noise(p, 24, 6), 1.1, 0.5))


def box_material(p: Array) -> Material:
    """Varnished wood outside and on the rim, white lacquer inside."""
    n = len(p)
    grain = noise(p * [0.8, 6, 6], 9.0, 7)
    wood = Material.uniform(n, (0.42, 0.25, 0.12), 0.35).shaded(1 + 0.12 * grain + 0.08 * noise(p * [2, 20, 20], 9.0, 8))
    x, y, z = BOX
    inside = (np.abs(p[:, 0]) < x - 0.9 * WALL) & (np.abs(p[:, 1]) < y - 0.9 * WALL) & (p[:, 2] > 0.9 * WALL) & (p[:, 2] < z - 0.002)
    return wood.blend(Material.uniform(n, (0.70, 0.69, 0.66), 0.55), inside.astype(float))


def shoe_material(p: Array) -> Material:
    """Brown leather with a darker cap and pale stitches, a white rubber sole and a cloth lining."""
    n, height = len(p), p[:, 2]
    leather = Material.uniform(n, (0.26, 0.11, 0.045), 0.38).shaded(1 + 0.06 * noise(p, 30, 2) + 0.05 * noise(p, 6, 3))
    cap = Material.uniform(n, (0.09, 0.04, 0.02), 0.3)
    pale = Material.uniform(n, (0.60, 0.50, 0.34), 0.7)
    seam = p[:, 0] - 0.42 + 0.6 * p[:, 1] ** 2
    upper = leather.blend(cap, step(seam, 0, 0.01))
    for edge in (-0.03, 0.03):
        stitched = (np.abs(seam - edge) < 0.006) & (np.sin(110 * p[:, 1] + 60 * height) > -0.3)
        upper = upper.blend(pale, stitched.astype(float))
    laced = (np.abs(p[:, 1]) < 0.13) & (p[:, 0] > -0.14) & (p[:, 0] < 0.22) & (np.sin(75 * p[:, 0]) > 0.55)
    upper = upper.blend(pale, laced.astype(float))
    sole = Material.uniform(n, (0.62, 0.61, 0.57), 0.6).shaded(1 - 0.3 * (np.sin(60 * height) > 0.9))
    lining = Material.uniform(n, (0.50, 0.40, 0.27), 0.9).shaded(1 + 0.05 * np.sin(140 * p[:, 0]) * np.sin(140 * p[:, 1]))
    outside = cKDTree(shoe_rings(np.array(SHOE), 400, 12).reshape(-1, 3))
    inner = (height > SOLE) & (outside.query(p)[0] > 0.018)
    return upper.blend(sole, (height < SOLE).astype(float)).blend(lining, inner.astype(float))
