"""Error of the specular light that shading looks up, against the sum of GGX over the sphere, under published environment maps.

python -m benchmarks.specular_lobe FOLDER … [--samples 200] [--seed 0]

FOLDER holds environment maps as in `benchmarks.light_levels`. Normals, views and roughnesses (.2 to .9) of a white metal are random; each
map is scaled to a mean of .7, white being 1; all have the albedo of a single scattering, as lobes are compared. Prints the PSNR of
displayed sRGB values, by n·v and by roughness, of

- `one lobe`: the light prefiltered at normal incidence, along the dominant direction of Lagarde & de Rousiers (2014),
- `two lobes`: what `gsbake.shading.split_sum` does.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.light_levels import environment_maps
from gsbake.geometry.vectors import unit
from gsbake.imaging.metrics import decibels
from gsbake.imaging.srgb import encode
from gsbake.shading import brdf, cubemap
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_tables import LightTables
from gsbake.shading.split_sum import shade

Floats = NDArray[np.float64]

#: Edge of the cube maps that are prefiltered, and of that over which GGX is summed; mean radiance of the maps.
SIZE, FINE_SIZE, MEAN_RADIANCE = 32, 96, 0.7
#: Bounds of the classes by n·v and by roughness.
COSINES, ROUGHNESSES = (0.15, 0.4, 0.6, 0.8, 1.0), (0.2, 0.3, 0.45, 0.6, 0.9)


@dataclass(frozen=True)
class Samples:
    """n random surfaces: unit `normal`, `view` (n, 3), `cosine` between them and `roughness` (n,)."""

    normal: Floats
    view: Floats
    cosine: Floats
    roughness: Floats

    @classmethod
    def draw(cls, count: int, rng: np.random.Generator) -> Samples:
        """`count` surfaces, uniform in direction, n·v and roughness."""
        normal, across = unit(rng.normal(size=(count, 3))), rng.normal(size=(count, 3))
        across = unit(across - (across * normal).sum(1, keepdims=True) * normal)
        cosine, roughness = rng.uniform(COSINES[0], COSINES[-1], count), rng.uniform(ROUGHNESSES[0], ROUGHNESSES[-1], count)
        view = cosine[:, None] * normal + np.sqrt(1 - cosine**2)[:, None] * across
        return cls(normal, view, cosine, roughness)

    def albedo(self) -> Floats:
        """Directional albedo (n, 1) of a white metal that scatters light once."""
        return brdf.directional_albedo(self.cosine, self.roughness**2)[:, :2].sum(1, keepdims=True)

    def exact(self, radiance: NDArray[Any]) -> Floats:
        """GGX of a white metal (n, 3) summed over the cube map `radiance` (6, SIZE, SIZE, 3)."""
        light, area = cubemap.directions(FINE_SIZE).reshape(-1, 3), cubemap.solid_angles(FINE_SIZE).ravel()
        incident = cubemap.sample(radiance, light).reshape(-1, 3) * area[:, None]
        out = np.zeros_like(self.normal)
        for i, (n, v, c, r) in enumerate(zip(self.normal, self.view, self.cosine, self.roughness, strict=True)):
            squared, nl = r**4, np.clip(light @ n, 0, 1)
            nh = np.clip(unit(light + v) @ n, 0, 1)
            density = squared / (np.pi * (nh**2 * (squared - 1) + 1) ** 2)
            smith = nl * np.sqrt(squared + (1 - squared) * c**2) + c * np.sqrt(squared + (1 - squared) * nl**2)
            out[i] = (density * nl / (2 * np.maximum(smith, 1e-12))) @ incident
        return out

    def one_lobe(self, tables: LightTables) -> Floats:
        """The same by the prefiltered light along the dominant direction."""
        alpha = self.roughness**2
        mirror = ((1 - alpha) * (np.sqrt(1 - alpha) + alpha))[:, None]
        direction = unit((1 + mirror * (2 * self.cosine[:, None] - 1)) * self.normal - mirror * self.view)
        light = tables.specular(torch.from_numpy(direction), torch.from_numpy(self.roughness))
        return light.numpy() * self.albedo()

    def two_lobes(self, tables: LightTables) -> Floats:
        """The same by the shading of the fit."""
        white, metal = torch.ones(len(self.normal), 3, dtype=torch.float64), torch.ones(len(self.normal), dtype=torch.float64)
        normal, view, roughness = (torch.from_numpy(x) for x in (self.normal, self.view, self.roughness))
        split = brdf.split_sum(torch.from_numpy(self.cosine), roughness)
        whole = (split.scale + split.bias).numpy()[:, None]
        return shade(normal, view, white, roughness, metal, tables).numpy() / whole * self.albedo()


def squared_errors(image: NDArray[np.float32], samples: Samples) -> tuple[Floats, Floats]:
    """Mean squared sRGB errors (n,) of one lobe and of two under an equirectangular image (h, w, 3)."""
    light = EnvironmentLight.from_equirectangular(np.maximum(image, 0), SIZE)
    radiance, area = light.radiance().detach().double(), torch.from_numpy(cubemap.solid_angles(SIZE)).double()
    radiance *= MEAN_RADIANCE * area.sum() / (radiance.mean(-1) * area).sum()
    tables = LightTables(EnvironmentLight.from_radiance(radiance).prefilter().detach().table.double(), light.prefilter().layout)

    def displayed(colour: Floats) -> Floats:
        return np.asarray(encode(np.clip(colour, 0, 1)))

    exact = displayed(samples.exact(radiance.numpy()))
    one, two = (displayed(found) - exact for found in (samples.one_lobe(tables), samples.two_lobes(tables)))
    return np.square(one).mean(1), np.square(two).mean(1)


def _classes(values: Floats, bounds: Sequence[float]) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    for low, high in zip(bounds[:-1], bounds[1:], strict=True):
        yield f"{low:g}–{high:g}", (values >= low) & (values <= high)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Error of the specular light that shading looks up.")
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    rng, maps = np.random.default_rng(options.seed), 0
    cosine, roughness, one, two = [], [], [], []
    for folder in options.folders:
        for _, image in environment_maps(folder):
            samples, maps = Samples.draw(options.samples, rng), maps + 1
            found = squared_errors(image, samples)
            for column, values in zip((cosine, roughness, one, two), (samples.cosine, samples.roughness, *found), strict=True):
                column.append(values)
    if not maps:
        parser.error("there are no environment maps in these folders")
    c, r, before, now = (np.concatenate(column) for column in (cosine, roughness, one, two))
    sys.stdout.write(f"{maps} maps\n| | one lobe dB | two lobes dB |\n|---|---|---|\n")
    rows = [("all", np.ones(len(c), bool))]
    rows += [(f"n·v {name}", chosen) for name, chosen in _classes(c, COSINES)]
    rows += [(f"roughness {name}", chosen) for name, chosen in _classes(r, ROUGHNESSES)]
    for name, chosen in rows:
        sys.stdout.write(f"| {name} | {decibels(before[chosen].mean()):.1f} | {decibels(now[chosen].mean()):.1f} |\n")


if __name__ == "__main__":
    main()
