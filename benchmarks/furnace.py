"""Directional albedo of the shading model against Blender's Cycles: spheres under an even white light.

python -m benchmarks.furnace --python PYTHON_WITH_BPY

Draws spheres of black dielectrics, which show their specular layer alone, and of metals, and prints the mean albedo by n·v: of Cycles
(`furnace_render`), of `gsbake.shading.brdf`, and of the formula with Schlick's Fresnel term and a single scattering for both, F0·A + B.
Pixels whose n·v is below .2 are left out: there the edge of the sphere lies within a pixel.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.imaging.exr import read_exr
from gsbake.shading import brdf

SCRIPT = Path(__file__).with_name("furnace_render.py")
#: Edge of a picture, which the sphere fills, in pixels; samples of a pixel.
SIZE, SAMPLES = 96, 512
ROUGHNESSES, METALS = (0.3, 0.56, 0.9), (0.3, 0.6, 0.9)
#: Bounds of the classes by n·v.
COSINES = ((0.2, 0.3), (0.4, 0.5), (0.6, 0.7), (0.95, 1.0))


def sphere_cosine() -> NDArray[np.float64]:
    """n·v (SIZE, SIZE) of a sphere that fills the picture, seen from far away; 0 outside it."""
    at = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    return np.sqrt(np.maximum(1 - at[:, None] ** 2 - at**2, 0))


def cycles_albedo(python: str, materials: Sequence[tuple[float, float, float]]) -> list[NDArray[np.float64]]:
    """Cycles' pictures (SIZE, SIZE) of spheres of base colour, roughness and metallic."""
    with tempfile.TemporaryDirectory() as folder:
        job = {"out": folder, "size": SIZE, "samples": SAMPLES, "materials": materials}
        path = Path(folder) / "job.json"
        path.write_text(json.dumps(job))
        subprocess.run([python, str(SCRIPT), str(path)], check=True, capture_output=True)
        return [np.asarray(read_exr(Path(folder) / f"{k}.exr")[..., 0], np.float64) for k in range(len(materials))]


def model_albedo(cosine: NDArray[np.float64], base: float, roughness: float, metallic: float) -> NDArray[np.float64]:
    """Directional albedo (n, 2) of the specular lobe at n·v (n,): of the shading model, and with Schlick's term and a single scattering."""
    split = brdf.split_sum(torch.from_numpy(cosine), torch.full((len(cosine),), roughness, dtype=torch.float64))
    model = base * split.scale + split.bias if metallic else split.dielectric
    f0 = base if metallic else 0.04
    single = brdf.directional_albedo(cosine, np.full(len(cosine), roughness**2)) @ [f0, 1, 0]
    return np.stack([model.numpy(), single], 1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Directional albedo of the shading model against Blender's Cycles.")
    parser.add_argument("--python", required=True, help="interpreter that has bpy")
    options = parser.parse_args(arguments)
    materials = [(0.0, r, 0.0) for r in ROUGHNESSES] + [(base, r, 1.0) for r in ROUGHNESSES for base in METALS]
    cosine = sphere_cosine()
    sys.stdout.write("| | roughness | n·v | Cycles | model | Schlick, single scattering |\n|---|---|---|---|---|---|\n")
    for (base, roughness, metallic), picture in zip(materials, cycles_albedo(options.python, materials), strict=True):
        name = f"metal {base:g}" if metallic else "dielectric"
        for low, high in COSINES:
            chosen = (cosine > low) & (cosine <= high)
            model, single = model_albedo(cosine[chosen], base, roughness, metallic).mean(0)
            row = f"{picture[chosen].mean():.4f} | {model:.4f} | {single:.4f}"
            sys.stdout.write(f"| {name} | {roughness:g} | {low:g}–{high:g} | {row} |\n")


if __name__ == "__main__":
    main()
