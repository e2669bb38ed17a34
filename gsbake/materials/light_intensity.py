"""How bright and how even the light is, and how rough the paint: a search of three numbers, every texel's best paint solved for each try.

Under one light that does not move, a brighter light and darker paint look nearly the same: only reflections tell them apart, whose strength
is known (.04 of the light, METHOD §6). Gradient steps find light and paint together and hardly move along that valley; above all an even
glow that they started from stays, because paint has taken up its share. Here the paint takes part as what it is given the light: for a
light L every texel's best base colour b in

    shade = b · E(n) + L(d) · (.04 A + B)

is a sum over its pixels, so that what the photos say of the light alone can be compared (variable projection; Golub & Pereyra, *The
differentiation of pseudo-inverses and nonlinear least squares problems whose variables separate*, 1973). Tried are lights

    L' = s · mean(L) · (L / mean(L))^γ / mean of the same

of other brightness s and contrast γ, and every texel rougher by one shift of logit(roughness), as long as the photos are explained
better, and at the end single colours of the light a little brighter or darker. Roughness takes part because a wrong one bends the light:
reflections that paint taken for too smooth would show, and photos do not, ask for a dim and even light, and the way out leads over a hill.
Base colours are found robustly by reweighting: a misplaced reflection must not decide. Errors are those of sRGB values, averaged over
blocks of a twelfth of the object before they count: a sharp reflection a few pixels off, right in strength, would otherwise ask for a
darker light, as noise in what explains always weakens what is found (attenuation; Fuller, *Measurement Error Models*, 1987).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.imaging.srgb import encode
from gsbake.materials.metallic import Evidence, by_eye

Floats = NDArray[np.float64]

#: Factors on brightness, exponents of contrast and shifts of logit(roughness) that are tried, until none helps.
BRIGHTER, STRONGER, ROUGHER = 1.2, 1.15, 0.4
#: Steps of brightness, contrast and roughness, in the order they are tried. Never smoother: a blurred light asks for that by itself.
WAYS = ((-1, 0, 0), (1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1))
#: Where else a search begins: a bright light on rough paint, as a valley of its own leads there.
ELSEWHERE = (2, 0, 4)
#: Factor on one colour of the light that is tried at the end.
TINT = 1.1
#: Furthest that the search goes: brightness, contrast and the shift of logit(roughness).
FURTHEST = (3.0, 2.0, 3.0)
#: A try must lower the error by this share; one of rougher paint by the second; where else it led by the third.
CLEARLY, SURELY, FAR = 0.002, 0.01, 0.03
#: Rounds of reweighting, and the error of an sRGB value from which pixels count less.
ROUNDS, NEAR = 2, 0.02


@dataclass(frozen=True)
class Level:
    """`brightness` s (3,) and `contrast` γ of the light that explains the photos best, with paint `rougher` by so much in logit(roughness);
    `gain` is the share of the error that went."""

    brightness: Floats
    contrast: float
    rougher: float
    gain: float

    def __str__(self) -> str:
        red, green, blue = self.brightness
        rougher = f", paint rougher by {self.rougher:+.1f}" if self.rougher else ""
        light = f"{red:.2f} {green:.2f} {blue:.2f} times as bright at contrast {self.contrast:.2f}"
        return f"{light}{rougher} ({self.gain:.1%} less unexplained)"

    def roughened(self, roughness: NDArray[Any]) -> NDArray[np.float32]:
        """`roughness` (n,) of paint, as much rougher."""
        return roughened(roughness, self.rougher)


def roughened(roughness: NDArray[Any], rougher: float) -> NDArray[np.float32]:
    """`roughness` (n,) with its logit shifted by `rougher`."""
    odds = np.clip(roughness, 1e-4, 1 - 1e-4)
    odds = odds / (1 - odds) * np.exp(rougher)
    return np.asarray(odds / (1 + odds), np.float32)


def graded(radiance: NDArray[Any], brightness: NDArray[Any], contrast: float, area: NDArray[Any]) -> NDArray[np.float32]:
    """The light `radiance` (6, s, s, 3) with its mean over the sphere, texels weighted by their solid angles `area` (6, s, s), times
    `brightness` (3,), and each direction's ratio to that mean raised to `contrast`."""

    def mean(light: NDArray[Any]) -> NDArray[Any]:
        return np.asarray((light * area[..., None]).sum((0, 1, 2)) / area.sum())

    level = mean(radiance)
    shape = (np.maximum(radiance, 1e-6) / level) ** contrast
    return np.asarray(brightness * level * shape / mean(shape), np.float32)


def find_level(
    evidence: Callable[[Floats, float], Sequence[Evidence]], roughness: NDArray[np.float32], tint: bool = True, rough: bool = True
) -> Level:
    """The brightness of each colour and the contrast under which paint explains most, and how much rougher than `roughness` (n,) it is.

    `evidence` gives the pixels of all photos under the light of a brightness (3,) and a contrast. Without `tint` colours stay as they are
    to one another, without `rough` the paint stays as rough as it is; with it, a second search begins far off.
    """
    seen: dict[_Place, Floats] = {}
    lit: dict[tuple[float, ...], Sequence[Evidence]] = {}

    def at(place: _Place) -> Floats:
        if place not in seen:
            light = (*place.brightness, STRONGER**place.stronger)
            if light not in lit:
                lit[light] = evidence(place.brightness, light[-1])
            seen[place] = _unexplained(lit[light], roughened(roughness, ROUGHER * place.rougher))
        return seen[place]

    def down(here: _Place) -> _Place:
        moved = True
        while moved:
            moved = False
            for way in (way for way in WAYS if rough or not way[2]):
                least = 1 - (SURELY if way[2] else CLEARLY)
                there = here.beside(*way)
                while there.near and at(there).sum() < least * at(here).sum():
                    here, there, moved = there, there.beside(*way), True
        return here

    start = _Place(0, 0, 0)
    here = down(start)
    if rough:
        there = down(start.beside(*ELSEWHERE))
        here = there if at(there).sum() < (1 - FAR) * at(here).sum() else here
    for sign in (-1, 1) if tint else ():
        all_three = replace(here, tint=(sign, sign, sign))
        better = at(all_three) < (1 - CLEARLY) * at(here)
        there = replace(here, tint=tuple(sign * int(b) for b in better))
        if 0 < better.sum() < 3 and at(there).sum() < at(here).sum():
            here = there
            break
    gain = float(1 - at(here).sum() / max(float(at(start).sum()), 1e-12))
    return Level(here.brightness, STRONGER**here.stronger, ROUGHER * here.rougher, gain)


@dataclass(frozen=True)
class _Place:
    """Where the search stands, in steps of brightness, contrast and roughness, and of each colour's tint."""

    brighter: int
    stronger: int
    rougher: int
    tint: tuple[int, ...] = (0, 0, 0)

    @property
    def brightness(self) -> Floats:
        return BRIGHTER**self.brighter * np.power(TINT, np.array(self.tint, np.float64))

    @property
    def near(self) -> bool:
        far = (BRIGHTER ** abs(self.brighter), STRONGER ** abs(self.stronger), ROUGHER * abs(self.rougher))
        return all(value <= most for value, most in zip(far, FURTHEST, strict=True))

    def beside(self, brighter: int, stronger: int, rougher: int) -> _Place:
        return _Place(self.brighter + brighter, self.stronger + stronger, self.rougher + rougher, self.tint)


def _unexplained(photos: Sequence[Evidence], roughness: NDArray[np.float32]) -> Floats:
    """Errors (3,) of the sRGB values that the best paint leaves, averaged over blocks of pixels."""
    offset = np.concatenate([photo.shade(0.0, roughness, 0.0) for photo in photos])
    slope = np.concatenate([photo.shade(1.0, roughness, 0.0) for photo in photos]) - offset
    colour, share = (np.concatenate([getattr(photo, name) for photo in photos]) for name in ("colour", "weight"))
    weight = np.concatenate([by_eye(photo) for photo in photos])
    texel = np.unique(np.concatenate([photo.texel for photo in photos]), return_inverse=True)[1]
    first = np.cumsum([0] + [int(photo.block.max(initial=-1)) + 1 for photo in photos])
    block = np.concatenate([photo.block + start for photo, start in zip(photos, first, strict=False)])
    shown, base = encode(colour), np.zeros((int(texel.max(initial=-1)) + 1, 3))

    def error() -> NDArray[Any]:
        return np.asarray(encode(base[texel] * slope + offset) - shown)

    for turn in range(ROUNDS + 1):
        use = weight / np.maximum(np.abs(error()), NEAR) if turn else weight
        for k in range(3):
            slopes = np.bincount(texel, use[:, k] * slope[:, k] ** 2)
            mixed = np.bincount(texel, use[:, k] * slope[:, k] * (colour - offset)[:, k])
            base[:, k] = np.clip(mixed / np.maximum(slopes, 1e-12), 0, 1)
    left = error() * share[:, None]
    return np.array([np.abs(np.bincount(block, left[:, k])).sum() for k in range(3)]) / max(float(share.sum()), 1e-12)
