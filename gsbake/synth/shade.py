"""Direct lighting of the analytic scene: a reference renderer that shares no code with the surfel rasteriser or the split sum.

Microfacet model: GGX with height-correlated Smith shadowing (Heitz, *Understanding the masking-shadowing function*, JCGT 2014), alpha =
roughness², and the Fresnel term `m (albedo + (1 - albedo) (1 - v.h)^5) + (1 - m) F`, Schlick's of metals and Fresnel's equations at the
index of refraction 1.5 of dielectrics; plus Lambert `(1 - m) albedo / pi` times what the specular layer of a dielectric lets through, one
minus its directional albedo (Kulla and Conty, *Revisiting physically based shading at Imageworks*, 2017). Light comes from a rectangle
(stratified points, each with a shadow ray), a sun (one shadow ray) and an environment whose radiance `a + b z` is linear in the
direction, so that its irradiance `pi (a + 2/3 b n_z)` is exact. Ambient visibility is sampled with hemisphere rays; the specular part is
summed over visible half vectors (Dupuy and Benyoub, *Sampling visible GGX normals with spherical caps*, CGF 2023).
The renderer is deterministic: the 2x2 samples of a pixel use interleaved subsets of the light and hemisphere points.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gsbake.synth.scene import distance, emission, ground, material, normal, trace

Array = NDArray[np.float64]

#: Interleaved subsets of the light and hemisphere points, one per sample of a pixel.
SAMPLE_SUBSETS = 4
_compiled: Any = njit(cache=True, nogil=True, error_model="numpy")
_inlined: Any = njit(cache=True, nogil=True, error_model="numpy", forceinline=True)


class LightRig(NamedTuple):
    """Lights in world coordinates; all values are linear RGB.

    Area light: `area_points` (n, 3) with n a multiple of SAMPLE_SUBSETS, each representing `patch_area`, with unit normal `area_normal`
    (3,) and radiance `area_radiance` (3,). Sun: unit `sun_direction` (3,) towards it, `sun_irradiance` (3,) at normal incidence.
    Environment: radiance `ambient` (3,) + `gradient` (3,) * z. Samples: `hemisphere` (m, 3) cosine-distributed directions around +z,
    `half_vector_samples` (k, 2) stratified points of the unit square.
    """

    area_points: Array
    area_normal: Array
    patch_area: float
    area_radiance: Array
    sun_direction: Array
    sun_irradiance: Array
    ambient: Array
    gradient: Array
    hemisphere: Array
    half_vector_samples: Array


def _van_der_corput(count: int) -> Array:
    """Base-2 radical inverses of 0..count-1 (the second Hammersley coordinate)."""
    out = np.zeros(count)
    index, weight = np.arange(count), 0.5
    while index.any():
        out += weight * (index & 1)
        index >>= 1
        weight *= 0.5
    return out


def make_light_rig(
    area: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sun: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ambient: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gradient: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sun_direction: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> LightRig:
    """Light rig with a 2 x 2 area light at (2.2, -2.4, 2.8) that faces the object, and a sun; black lights are not evaluated."""
    centre, target = np.array([2.2, -2.4, 2.8]), np.array([0.3, -0.1, 0.45])
    area_normal = (target - centre) / np.linalg.norm(target - centre)
    u = np.cross(area_normal, [0, 0, 1.0])
    u /= np.linalg.norm(u)
    v = np.cross(area_normal, u)
    steps = (np.arange(4) + 0.5) / 2 - 1
    # Ordered so that every fourth point forms a well-distributed subset (a Latin square of the 4 x 4 strata).
    order = sorted(((i, j) for i in range(4) for j in range(4)), key=lambda ij: (ij[0], (ij[1] + ij[0]) % SAMPLE_SUBSETS))
    area_points = np.array([centre + u * steps[i] + v * steps[j] for i, j in order])
    count = 16
    # Golden-angle spiral: every fourth direction is well distributed too.
    radius, angle = np.sqrt((np.arange(count) + 0.5) / count), np.pi * (3 - np.sqrt(5)) * np.arange(count)
    direction = np.array(sun_direction, float)
    return LightRig(
        area_points=area_points,
        area_normal=area_normal,
        patch_area=4.0 / len(area_points),
        area_radiance=np.array(area, float),
        sun_direction=direction / np.linalg.norm(direction),
        sun_irradiance=np.array(sun, float),
        ambient=np.array(ambient, float),
        gradient=np.array(gradient, float),
        hemisphere=np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], 1),
        half_vector_samples=np.stack([(np.arange(count) + 0.5) / count, _van_der_corput(count)], 1),
    )


def studio_rig() -> LightRig:
    """Lighting of the built-in capture: a warm area light as key, a weak cool sun from behind, a bluish sky above darker ground."""
    return make_light_rig(
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


@_inlined
def _dielectric_fresnel(cosine: float) -> float:
    """Reflectance of a dielectric of index of refraction 1.5 at the cosine of incidence, for unpolarised light."""
    refracted = math.sqrt(1 - (1 - cosine * cosine) / (1.5 * 1.5))
    across = (cosine - 1.5 * refracted) / (cosine + 1.5 * refracted)
    along = (1.5 * cosine - refracted) / (1.5 * cosine + refracted)
    return 0.5 * (across * across + along * along)


@_compiled
def brdf_cosine(
    light: tuple[float, float, float],
    n: tuple[float, float, float],
    v: tuple[float, float, float],
    surface: tuple[float, float, float, float, float],
    transmitted: float,
) -> tuple[float, float, float]:
    """BRDF times cos(theta_l) (3); unit directions to light and camera, unit normal n, surface = albedo (3), roughness, metallic.

    `transmitted` is the share of diffuse reflection that the specular layer lets through.
    """
    nl = n[0] * light[0] + n[1] * light[1] + n[2] * light[2]
    if nl <= 0:
        return 0.0, 0.0, 0.0
    nv = max(n[0] * v[0] + n[1] * v[1] + n[2] * v[2], 1e-4)
    hx, hy, hz = light[0] + v[0], light[1] + v[1], light[2] + v[2]
    length = math.sqrt(hx * hx + hy * hy + hz * hz) + 1e-12
    nh = (n[0] * hx + n[1] * hy + n[2] * hz) / length
    lh = (light[0] * hx + light[1] * hy + light[2] * hz) / length
    specular = _microfacet(nl, nv, nh, surface[3] * surface[3])
    schlick, dielectric = (1 - lh) ** 5, (1 - surface[4]) * _dielectric_fresnel(lh)
    diffuse, metal = transmitted * (1 - surface[4]) / math.pi, surface[4] * (1 - schlick)
    edge = dielectric + surface[4] * schlick
    return (
        nl * (diffuse * surface[0] + specular * (metal * surface[0] + edge)),
        nl * (diffuse * surface[1] + specular * (metal * surface[1] + edge)),
        nl * (diffuse * surface[2] + specular * (metal * surface[2] + edge)),
    )


@_inlined
def _occluded(x: float, y: float, z: float, dx: float, dy: float, dz: float) -> bool:
    return trace(x, y, z, dx, dy, dz, 0.0, 1e-4) >= 0


@_inlined
def _tangents(n: tuple[float, float, float]) -> tuple[float, float, float, float, float, float]:
    """Two unit tangents of n without branches (Duff et al., *Building an orthonormal basis, revisited*, JCGT 2017)."""
    sign = math.copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return 1 + sign * n[0] * n[0] * a, sign * b, -sign * n[0], b, sign + n[1] * n[1] * a, -n[1]


@_compiled
def _area_light(
    position: tuple[float, float, float],
    n: tuple[float, float, float],
    v: tuple[float, float, float],
    surface: tuple[float, float, float, float, float],
    rig: LightRig,
    subset: int,
    transmitted: float,
) -> tuple[float, float, float]:
    """Reflected radiance (3) of the area light, by every fourth of its points from `subset`, each with a shadow ray."""
    x, y, z = position
    r = g = b = 0.0
    for i in range(subset, len(rig.area_points), SAMPLE_SUBSETS):
        lx, ly, lz = rig.area_points[i, 0] - x, rig.area_points[i, 1] - y, rig.area_points[i, 2] - z
        squared = lx * lx + ly * ly + lz * lz
        inverse = 1 / math.sqrt(squared)
        lx, ly, lz = lx * inverse, ly * inverse, lz * inverse
        emitted = -(lx * rig.area_normal[0] + ly * rig.area_normal[1] + lz * rig.area_normal[2])
        fr, fg, fb = brdf_cosine((lx, ly, lz), n, v, surface, transmitted)
        if emitted > 0 and fr + fg + fb > 0 and not _occluded(x, y, z, lx, ly, lz):
            angle = SAMPLE_SUBSETS * rig.patch_area * emitted / squared  # solid angle of the patch
            radiance = rig.area_radiance
            r, g, b = r + fr * angle * radiance[0], g + fg * angle * radiance[1], b + fb * angle * radiance[2]
    return r, g, b


@_compiled
def _sun_light(
    position: tuple[float, float, float],
    n: tuple[float, float, float],
    v: tuple[float, float, float],
    surface: tuple[float, float, float, float, float],
    rig: LightRig,
    transmitted: float,
) -> tuple[float, float, float]:
    """Reflected radiance (3) of the sun, with one shadow ray."""
    direction, irradiance = rig.sun_direction, rig.sun_irradiance
    fr, fg, fb = brdf_cosine((direction[0], direction[1], direction[2]), n, v, surface, transmitted)
    if fr + fg + fb > 0 and not _occluded(position[0], position[1], position[2], direction[0], direction[1], direction[2]):
        return fr * irradiance[0], fg * irradiance[1], fb * irradiance[2]
    return 0.0, 0.0, 0.0


@_compiled
def _ambient_visibility(
    position: tuple[float, float, float],
    n: tuple[float, float, float],
    tangents: tuple[float, float, float, float, float, float],
    rig: LightRig,
    subset: int,
) -> float:
    """Unoccluded share of the cosine-weighted hemisphere, by every fourth of the rig's directions from `subset`."""
    x, y, z = position
    tx, ty, tz, ux, uy, uz = tangents
    visible = 0.0
    for i in range(subset, len(rig.hemisphere), SAMPLE_SUBSETS):
        a, c, e = rig.hemisphere[i, 0], rig.hemisphere[i, 1], rig.hemisphere[i, 2]
        if not _occluded(x, y, z, a * tx + c * ux + e * n[0], a * ty + c * uy + e * n[1], a * tz + c * uz + e * n[2]):
            visible += 1.0
    return visible * (SAMPLE_SUBSETS / len(rig.hemisphere))


@_compiled
def _environment_specular(
    n: tuple[float, float, float],
    v: tuple[float, float, float],
    surface: tuple[float, float, float, float, float],
    tangents: tuple[float, float, float, float, float, float],
    rig: LightRig,
) -> tuple[float, float, float, float]:
    """Unoccluded specular reflection (3) of the environment, by visible half vectors (Dupuy and Benyoub 2023) weighted with F G2 / G1, and
    the directional albedo of a dielectric."""
    tx, ty, tz, ux, uy, uz = tangents
    alpha = surface[3] * surface[3]
    a2 = alpha * alpha
    nv = max(n[0] * v[0] + n[1] * v[1] + n[2] * v[2], 1e-4)
    wx, wy = alpha * (v[0] * tx + v[1] * ty + v[2] * tz), alpha * (v[0] * ux + v[1] * uy + v[2] * uz)
    inverse = 1 / math.sqrt(wx * wx + wy * wy + nv * nv)
    wx, wy, wz = wx * inverse, wy * inverse, nv * inverse
    smith_v = math.sqrt(a2 + (1 - a2) * nv * nv)
    r = g = b = reflected = 0.0
    for i in range(len(rig.half_vector_samples)):
        c = (1 - rig.half_vector_samples[i, 0]) * (1 + wz) - wz
        sin, phi = math.sqrt(max(1 - c * c, 0.0)), 2 * math.pi * rig.half_vector_samples[i, 1]
        hx, hy, hz = alpha * (sin * math.cos(phi) + wx), alpha * (sin * math.sin(phi) + wy), c + wz
        inverse = 1 / math.sqrt(hx * hx + hy * hy + hz * hz)
        hx, hy, nh = hx * inverse, hy * inverse, hz * inverse
        hx, hy, hz = hx * tx + hy * ux + nh * n[0], hx * ty + hy * uy + nh * n[1], hx * tz + hy * uz + nh * n[2]
        vh = v[0] * hx + v[1] * hy + v[2] * hz
        nl = 2 * vh * nh - (n[0] * v[0] + n[1] * v[1] + n[2] * v[2])
        if vh <= 0 or nl <= 0:
            continue
        weight = nl * (smith_v + nv) / (nl * smith_v + nv * math.sqrt(a2 + (1 - a2) * nl * nl))
        schlick, dielectric = (1 - vh) ** 5, _dielectric_fresnel(vh)
        reflected += weight * dielectric
        metal, edge = surface[4] * (1 - schlick), (1 - surface[4]) * dielectric + surface[4] * schlick
        lz = 2 * vh * hz - v[2]
        r += weight * (metal * surface[0] + edge) * (rig.ambient[0] + rig.gradient[0] * lz)
        g += weight * (metal * surface[1] + edge) * (rig.ambient[1] + rig.gradient[1] * lz)
        b += weight * (metal * surface[2] + edge) * (rig.ambient[2] + rig.gradient[2] * lz)
    count = len(rig.half_vector_samples)
    return r / count, g / count, b / count, reflected / count


@_compiled
def outgoing_radiance(
    point: tuple[float, float, float],
    n: tuple[float, float, float],
    v: tuple[float, float, float],
    surface: tuple[float, float, float, float, float],
    rig: LightRig,
    subset: int,
) -> tuple[float, float, float]:
    """Radiance (3) leaving a surface point (world) towards unit direction v: area light, sun, environment, each with self-shadowing.

    `subset` 0..3 selects every fourth light and hemisphere point; the mean of the four is the full quadrature.
    """
    offset = 2e-3
    position = (point[0] + offset * n[0], point[1] + offset * n[1], point[2] + offset * n[2])
    tangents = _tangents(n)
    sr, sg, sb, reflected = _environment_specular(n, v, surface, tangents, rig)
    transmitted = 1 - reflected
    r = g = b = 0.0
    if rig.area_radiance[0] + rig.area_radiance[1] + rig.area_radiance[2] > 0:
        r, g, b = _area_light(position, n, v, surface, rig, subset, transmitted)
    if rig.sun_irradiance[0] + rig.sun_irradiance[1] + rig.sun_irradiance[2] > 0:
        sun_r, sun_g, sun_b = _sun_light(position, n, v, surface, rig, transmitted)
        r, g, b = r + sun_r, g + sun_g, b + sun_b
    visible = _ambient_visibility(position, n, tangents, rig, subset)
    diffuse, slope = transmitted * (1 - surface[4]), 2 / 3 * n[2]  # irradiance over pi is ambient + 2/3 gradient n_z
    return (
        r + visible * (diffuse * surface[0] * (rig.ambient[0] + rig.gradient[0] * slope) + sr),
        g + visible * (diffuse * surface[1] * (rig.ambient[1] + rig.gradient[1] * slope) + sg),
        b + visible * (diffuse * surface[2] * (rig.ambient[2] + rig.gradient[2] * slope) + sb),
    )


@_compiled
def render(
    rotation: Array, centre: Array, fx: float, fy: float, cx: float, cy: float, width: int, height: int, rig: LightRig, background: bool,
    marker: NDArray[np.uint8],
) -> tuple[Array, Array]:  # fmt: skip
    """One photo with 2x2 samples per pixel: linear RGB + coverage (h, w, 4) and the surface buffers (h, w, 11), premultiplied.

    Buffers: albedo (3), normal (3), roughness, metallic, emission (3).

    `rotation` (3, 3) world→camera with OpenCV axes, `centre` (3,) of the camera in the world. With `background` the colour channels include
    the ground with the cells (k, k) of a printed `marker` (k = 0: none) and the environment; coverage remains that of the object.
    """
    image, buffers = np.zeros((height, width, 4)), np.zeros((height, width, 11))
    ox, oy, oz = centre[0], centre[1], centre[2]
    for j in range(height):
        for i in range(width):
            for k in range(SAMPLE_SUBSETS):
                px = (i + 0.25 + 0.5 * (k & 1) - cx) / fx
                py = (j + 0.25 + 0.5 * (k >> 1) - cy) / fy
                dx = rotation[0, 0] * px + rotation[1, 0] * py + rotation[2, 0]
                dy = rotation[0, 1] * px + rotation[1, 1] * py + rotation[2, 1]
                dz = rotation[0, 2] * px + rotation[1, 2] * py + rotation[2, 2]
                inverse = 1 / math.sqrt(dx * dx + dy * dy + dz * dz)
                dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
                t = trace(ox, oy, oz, dx, dy, dz, 0.0, 1e-5)
                if t >= 0:
                    t += distance(ox + t * dx, oy + t * dy, oz + t * dz)  # one more step, onto the surface
                    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
                    n = normal(x, y, z)
                    surface = material(x, y, z)
                    emitted = emission(x, y, z)
                    r, g, b = outgoing_radiance((x, y, z), n, (-dx, -dy, -dz), surface, rig, k)
                    r, g, b = r + emitted[0], g + emitted[1], b + emitted[2]
                    image[j, i, 3] += 0.25
                    for c in range(3):
                        buffers[j, i, c] += 0.25 * surface[c]
                        buffers[j, i, 3 + c] += 0.25 * n[c]
                        buffers[j, i, 8 + c] += 0.25 * emitted[c]
                    buffers[j, i, 6] += 0.25 * surface[3]
                    buffers[j, i, 7] += 0.25 * surface[4]
                elif not background:
                    continue
                elif dz < -1e-3:
                    x, y = ox - oz / dz * dx, oy - oz / dz * dy
                    albedo = ground(x, y, marker)
                    surface = (albedo[0], albedo[1], albedo[2], 0.9, 0.0)
                    r, g, b = outgoing_radiance((x, y, 0.0), (0.0, 0.0, 1.0), (-dx, -dy, -dz), surface, rig, k)
                else:
                    r, g, b = (
                        rig.ambient[0] + rig.gradient[0] * dz,
                        rig.ambient[1] + rig.gradient[1] * dz,
                        rig.ambient[2] + rig.gradient[2] * dz,
                    )
                image[j, i, 0] += 0.25 * r
                image[j, i, 1] += 0.25 * g
                image[j, i, 2] += 0.25 * b
    return image, buffers
