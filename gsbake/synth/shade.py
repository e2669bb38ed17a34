"""Direct-light shading of the analytic scene: its own renderer, sharing no code with the splat rasteriser or the split sum.

Microfacet model: GGX with height-correlated Smith shadowing (Heitz, *Understanding the masking-shadowing function*, JCGT 2014) and
Schlick's Fresnel, `F0 = .04 (1 - m) + m albedo`, alpha = roughness²; plus Lambert `(1 - m) albedo / pi`. Light comes from a rectangle
(stratified points, each with a shadow ray), a sun (one shadow ray) and an environment whose radiance `a + b z` is linear in the
direction, so that its irradiance `pi (a + 2/3 b n_z)` is exact; ambient visibility is measured with hemisphere rays, its specular part is
summed over visible half vectors (Dupuy and Benyoub, *Sampling visible GGX normals with spherical caps*, CGF 2023).
Everything is deterministic: the 2x2 samples of a pixel use interleaved subsets of the light and hemisphere points.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gsbake.synth.scene import distance, emission, ground, material, normal, trace

Array = NDArray[np.float64]

SUBSETS = 4  # interleaved subsets of the light and hemisphere points, one per sample of a pixel
_compiled: Any = njit(cache=True, nogil=True, error_model="numpy")
_inlined: Any = njit(cache=True, nogil=True, error_model="numpy", inline="always")


class Rig(NamedTuple):
    """Lights in world coordinates; all values are linear RGB.

    `points` (n, 3) on the area light (n a multiple of SUBSETS), each standing for `patch` area units facing `facing` (3,) with `radiance`
    (3,); `sun` (3,) unit direction towards the sun, `irradiance` (3,) at normal incidence; environment: `ambient` (3,) + `gradient` (3,)
    * z; `cosine` (m, 3) cosine-distributed hemisphere directions about +z, `square` (k, 2) stratified points for the half vectors.
    """

    points: Array
    facing: Array
    patch: float
    radiance: Array
    sun: Array
    irradiance: Array
    ambient: Array
    gradient: Array
    cosine: Array
    square: Array


def _van_der_corput(count: int) -> Array:
    """Base-2 radical inverses of 0..count-1 (the second Hammersley coordinate)."""
    out = np.zeros(count)
    index, weight = np.arange(count), 0.5
    while index.any():
        out += weight * (index & 1)
        index >>= 1
        weight *= 0.5
    return out


def make_rig(
    area: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sun: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ambient: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gradient: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sun_direction: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Rig:
    """A rig with a 2 x 2 area light at (2.2, -2.4, 2.8) facing the object and a sun; black parts cost nothing."""
    centre, aim = np.array([2.2, -2.4, 2.8]), np.array([0.3, -0.1, 0.45])
    facing = (aim - centre) / np.linalg.norm(aim - centre)
    u = np.cross(facing, [0, 0, 1.0])
    u /= np.linalg.norm(u)
    v = np.cross(facing, u)
    steps = (np.arange(4) + 0.5) / 2 - 1
    # Ordered so that every fourth point makes a spread-out subset (a Latin square of the 4 x 4 strata).
    order = sorted(((i, j) for i in range(4) for j in range(4)), key=lambda ij: (ij[0], (ij[1] + ij[0]) % SUBSETS))
    points = np.array([centre + u * steps[i] + v * steps[j] for i, j in order])
    count = 16
    # Golden-angle spiral: every fourth direction is spread out as well.
    radial, turn = np.sqrt((np.arange(count) + 0.5) / count), np.pi * (3 - np.sqrt(5)) * np.arange(count)
    cosine = np.stack([radial * np.cos(turn), radial * np.sin(turn), np.sqrt(1 - radial**2)], 1)
    square = np.stack([(np.arange(count) + 0.5) / count, _van_der_corput(count)], 1)
    direction = np.array(sun_direction, float)
    return Rig(
        points, facing, 4.0 / len(points), np.array(area, float), direction / np.linalg.norm(direction), np.array(sun, float),
        np.array(ambient, float), np.array(gradient, float), cosine, square,
    )  # fmt: skip


def studio() -> Rig:
    """The capture's light: warm key from an area light, a weak cool sun from behind, a bluish sky over a darker floor."""
    return make_rig(
        area=(8.5, 7.9, 7.0),
        sun=(0.55, 0.62, 0.75),
        ambient=(0.50, 0.51, 0.53),
        gradient=(0.30, 0.33, 0.37),
        sun_direction=(-0.7, 0.9, 0.8),
    )


@_inlined
def _microfacet(nl: float, nv: float, nh: float, alpha: float) -> float:
    """D V of GGX: distribution times visibility G / (4 nl nv)."""
    a2 = alpha * alpha
    base = nh * nh * (a2 - 1) + 1
    smith = nl * math.sqrt(nv * nv * (1 - a2) + a2) + nv * math.sqrt(nl * nl * (1 - a2) + a2)
    return a2 / (math.pi * base * base) * 0.5 / smith


@_compiled
def reflect(
    light: tuple[float, float, float],
    n: tuple[float, float, float],
    v: tuple[float, float, float],
    surface: tuple[float, float, float, float, float],
) -> tuple[float, float, float]:
    """BRDF times cos(theta_l) (3) for unit directions to light and eye about unit normal n; surface = albedo (3), roughness, metallic."""
    nl = n[0] * light[0] + n[1] * light[1] + n[2] * light[2]
    if nl <= 0:
        return 0.0, 0.0, 0.0
    nv = max(n[0] * v[0] + n[1] * v[1] + n[2] * v[2], 1e-4)
    hx, hy, hz = light[0] + v[0], light[1] + v[1], light[2] + v[2]
    length = math.sqrt(hx * hx + hy * hy + hz * hz) + 1e-12
    nh = (n[0] * hx + n[1] * hy + n[2] * hz) / length
    lh = (light[0] * hx + light[1] * hy + light[2] * hz) / length
    specular = _microfacet(nl, nv, nh, surface[3] * surface[3])
    schlick = (1 - lh) ** 5
    diffuse = (1 - surface[4]) / math.pi
    base = 0.04 * (1 - surface[4])
    r0, g0, b0 = base + surface[4] * surface[0], base + surface[4] * surface[1], base + surface[4] * surface[2]
    return (
        nl * (diffuse * surface[0] + specular * (r0 + (1 - r0) * schlick)),
        nl * (diffuse * surface[1] + specular * (g0 + (1 - g0) * schlick)),
        nl * (diffuse * surface[2] + specular * (b0 + (1 - b0) * schlick)),
    )


@_inlined
def _blocked(x: float, y: float, z: float, dx: float, dy: float, dz: float) -> bool:
    return trace(x, y, z, dx, dy, dz, 0.0, 1e-4) >= 0


@_inlined
def _frame(n: tuple[float, float, float]) -> tuple[float, float, float, float, float, float]:
    """Two unit tangents of n without branches (Duff et al., *Building an orthonormal basis, revisited*, JCGT 2017)."""
    sign = math.copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return 1 + sign * n[0] * n[0] * a, sign * b, -sign * n[0], b, sign + n[1] * n[1] * a, -n[1]


@_compiled
def outgoing(
    point: tuple[float, float, float],
    n: tuple[float, float, float],
    v: tuple[float, float, float],
    surface: tuple[float, float, float, float, float],
    rig: Rig,
    subset: int,
) -> tuple[float, float, float]:
    """Radiance (3) leaving a surface point (world) towards unit direction v: area light, sun, environment, each with the object's shadow.

    `subset` 0..3 selects every fourth light and hemisphere point; the mean of the four is the full quadrature.
    """
    offset = 2e-3
    x, y, z = point[0] + offset * n[0], point[1] + offset * n[1], point[2] + offset * n[2]
    r = g = b = 0.0
    if rig.radiance[0] + rig.radiance[1] + rig.radiance[2] > 0:
        for i in range(subset, len(rig.points), SUBSETS):
            lx, ly, lz = rig.points[i, 0] - x, rig.points[i, 1] - y, rig.points[i, 2] - z
            square = lx * lx + ly * ly + lz * lz
            inverse = 1 / math.sqrt(square)
            lx, ly, lz = lx * inverse, ly * inverse, lz * inverse
            emitted = -(lx * rig.facing[0] + ly * rig.facing[1] + lz * rig.facing[2])
            fr, fg, fb = reflect((lx, ly, lz), n, v, surface)
            if emitted > 0 and fr + fg + fb > 0 and not _blocked(x, y, z, lx, ly, lz):
                angle = SUBSETS * rig.patch * emitted / square  # solid angle of the patch
                r, g, b = r + fr * angle * rig.radiance[0], g + fg * angle * rig.radiance[1], b + fb * angle * rig.radiance[2]
    if rig.irradiance[0] + rig.irradiance[1] + rig.irradiance[2] > 0:
        fr, fg, fb = reflect((rig.sun[0], rig.sun[1], rig.sun[2]), n, v, surface)
        if fr + fg + fb > 0 and not _blocked(x, y, z, rig.sun[0], rig.sun[1], rig.sun[2]):
            r, g, b = r + fr * rig.irradiance[0], g + fg * rig.irradiance[1], b + fb * rig.irradiance[2]
    tx, ty, tz, ux, uy, uz = _frame(n)
    free = 0.0
    for i in range(subset, len(rig.cosine), SUBSETS):
        a, c, e = rig.cosine[i, 0], rig.cosine[i, 1], rig.cosine[i, 2]
        if not _blocked(x, y, z, a * tx + c * ux + e * n[0], a * ty + c * uy + e * n[1], a * tz + c * uz + e * n[2]):
            free += 1.0
    free *= SUBSETS / len(rig.cosine)
    # Environment: exact diffuse part; specular part by visible half vectors (Dupuy and Benyoub 2023), each weighing F G2 / G1.
    alpha = surface[3] * surface[3]
    a2 = alpha * alpha
    nv = max(n[0] * v[0] + n[1] * v[1] + n[2] * v[2], 1e-4)
    base = 0.04 * (1 - surface[4])
    r0, g0, b0 = base + surface[4] * surface[0], base + surface[4] * surface[1], base + surface[4] * surface[2]
    wx, wy = alpha * (v[0] * tx + v[1] * ty + v[2] * tz), alpha * (v[0] * ux + v[1] * uy + v[2] * uz)
    inverse = 1 / math.sqrt(wx * wx + wy * wy + nv * nv)
    wx, wy, wz = wx * inverse, wy * inverse, nv * inverse
    reach = math.sqrt(a2 + (1 - a2) * nv * nv)
    sr = sg = sb = 0.0
    for i in range(len(rig.square)):
        c = (1 - rig.square[i, 0]) * (1 + wz) - wz
        sin, turn = math.sqrt(max(1 - c * c, 0.0)), 2 * math.pi * rig.square[i, 1]
        hx, hy, hz = alpha * (sin * math.cos(turn) + wx), alpha * (sin * math.sin(turn) + wy), c + wz
        inverse = 1 / math.sqrt(hx * hx + hy * hy + hz * hz)
        hx, hy, nh = hx * inverse, hy * inverse, hz * inverse
        hx, hy, hz = hx * tx + hy * ux + nh * n[0], hx * ty + hy * uy + nh * n[1], hx * tz + hy * uz + nh * n[2]
        vh = v[0] * hx + v[1] * hy + v[2] * hz
        nl = 2 * vh * nh - (n[0] * v[0] + n[1] * v[1] + n[2] * v[2])
        if vh <= 0 or nl <= 0:
            continue
        weight = nl * (reach + nv) / (nl * reach + nv * math.sqrt(a2 + (1 - a2) * nl * nl))
        schlick = (1 - vh) ** 5
        height = 2 * vh * hz - v[2]
        sr += weight * (r0 + (1 - r0) * schlick) * (rig.ambient[0] + rig.gradient[0] * height)
        sg += weight * (g0 + (1 - g0) * schlick) * (rig.ambient[1] + rig.gradient[1] * height)
        sb += weight * (b0 + (1 - b0) * schlick) * (rig.ambient[2] + rig.gradient[2] * height)
    count, matte, tilt = len(rig.square), 1 - surface[4], 2 / 3 * n[2]
    return (
        r + free * (matte * surface[0] * (rig.ambient[0] + rig.gradient[0] * tilt) + sr / count),
        g + free * (matte * surface[1] * (rig.ambient[1] + rig.gradient[1] * tilt) + sg / count),
        b + free * (matte * surface[2] * (rig.ambient[2] + rig.gradient[2] * tilt) + sb / count),
    )


@_compiled
def render(
    rotation: Array, centre: Array, fx: float, fy: float, cx: float, cy: float, width: int, height: int, rig: Rig, background: bool
) -> tuple[Array, Array]:
    """One photo with 2x2 samples a pixel: linear RGB + coverage (h, w, 4) and the surface buffers (h, w, 11), premultiplied.

    Buffers: albedo (3), normal (3), roughness, metallic, emission (3).

    `rotation` (3, 3) world→camera with OpenCV axes, `centre` (3,) the camera in the world. With `background` the colour channels also hold
    the ground and the environment behind it; coverage stays the object's.
    """
    picture, buffers = np.zeros((height, width, 4)), np.zeros((height, width, 11))
    ox, oy, oz = centre[0], centre[1], centre[2]
    for j in range(height):
        for i in range(width):
            for k in range(SUBSETS):
                px = (i + 0.25 + 0.5 * (k & 1) - cx) / fx
                py = (j + 0.25 + 0.5 * (k >> 1) - cy) / fy
                dx = rotation[0, 0] * px + rotation[1, 0] * py + rotation[2, 0]
                dy = rotation[0, 1] * px + rotation[1, 1] * py + rotation[2, 1]
                dz = rotation[0, 2] * px + rotation[1, 2] * py + rotation[2, 2]
                inverse = 1 / math.sqrt(dx * dx + dy * dy + dz * dz)
                dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
                t = trace(ox, oy, oz, dx, dy, dz, 0.0, 1e-5)
                if t >= 0:
                    t += distance(ox + t * dx, oy + t * dy, oz + t * dz)  # one step more: on the surface
                    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
                    n = normal(x, y, z)
                    surface = material(x, y, z)
                    glow = emission(x, y, z)
                    r, g, b = outgoing((x, y, z), n, (-dx, -dy, -dz), surface, rig, k)
                    r, g, b = r + glow[0], g + glow[1], b + glow[2]
                    picture[j, i, 3] += 0.25
                    for c in range(3):
                        buffers[j, i, c] += 0.25 * surface[c]
                        buffers[j, i, 3 + c] += 0.25 * n[c]
                        buffers[j, i, 8 + c] += 0.25 * glow[c]
                    buffers[j, i, 6] += 0.25 * surface[3]
                    buffers[j, i, 7] += 0.25 * surface[4]
                elif not background:
                    continue
                elif dz < -1e-3:
                    x, y = ox - oz / dz * dx, oy - oz / dz * dy
                    shade = ground(x, y)
                    r, g, b = outgoing((x, y, 0.0), (0.0, 0.0, 1.0), (-dx, -dy, -dz), (shade[0], shade[1], shade[2], 0.9, 0.0), rig, k)
                else:
                    r, g, b = (
                        rig.ambient[0] + rig.gradient[0] * dz,
                        rig.ambient[1] + rig.gradient[1] * dz,
                        rig.ambient[2] + rig.gradient[2] * dz,
                    )
                picture[j, i, 0] += 0.25 * r
                picture[j, i, 1] += 0.25 * g
                picture[j, i, 2] += 0.25 * b
    return picture, buffers
