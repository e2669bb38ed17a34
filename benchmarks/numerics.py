"""Error of the float32 kernels against the float64 reference over scales and fields of view.

python -m benchmarks.numerics [--csv FILE]
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.csv_rows import today, write_rows
from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.raster.rasterise import render
from gsbake.surfels.raster.reference import render_reference

SCALES = (1e-8, 1e-4, 1e-2, 1e-1, 1.0, 1e4)
FIELDS = (1.0, 20.0, 50.0, 90.0, 150.0, 170.0)
SURFELS, WIDTH, HEIGHT, SEEDS = 60, 61, 47, 3
PLANES = ("features", "depth", "alpha", "distortion")
RESULTS = Path(__file__).parent / "results" / "numerics.csv"


@dataclass(frozen=True)
class Row:
    """One scale (against the unit frame at distance 3) and field of view in degrees, the worst of the seeds: relative RMS error of the
    colours, share of pixels off by more than 1e-4 of the brightest, relative RMS error of the worst other plane."""

    scale: float
    field: float
    colour: float
    off: float
    other: float
    date: str = dataclasses.field(default_factory=today)

    @property
    def key(self) -> tuple[str, ...]:
        """Rows of one scale and field of view replace each other."""
        return str(self.scale), str(self.field)


def scene(scale: float, field: float, seed: int) -> tuple[list[Tensor], Pinhole]:
    """Surfels that fill the frame at any `field` of view (degrees), float64; `scale` is relative to the unit frame at distance 3."""
    g = torch.Generator().manual_seed(seed)
    depth = 2.5 + torch.rand(SURFELS, generator=g, dtype=torch.float64)
    half = math.tan(math.radians(field) / 2)
    across = (2 * torch.rand(SURFELS, 2, generator=g, dtype=torch.float64) - 1) * half * depth[:, None]
    position = torch.cat([across, depth[:, None]], 1)
    quaternion = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64) + 0.4 * torch.randn(SURFELS, 4, generator=g, dtype=torch.float64)
    log_scale = math.log(scale) + 0.3 * torch.randn(SURFELS, 2, generator=g, dtype=torch.float64)
    opacity = 0.1 + 0.85 * torch.rand(SURFELS, generator=g, dtype=torch.float64)
    features = torch.rand(SURFELS, 3, generator=g, dtype=torch.float64)
    focal = WIDTH / 2 / half
    inputs = [position, quaternion, log_scale, opacity, features, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)]
    # the scene is rounded to float32: input rounding is not an error of the kernels
    return [x.float().double() for x in inputs], Pinhole(WIDTH, HEIGHT, focal, 1.1 * focal, 0.45 * WIDTH, 0.6 * HEIGHT)


def errors(scale: float, field: float) -> tuple[float, float, float]:
    """Relative RMS error of the colours, share of pixels off by more than 1e-4 of the brightest, worst RMS of the other planes."""
    colour, off, other = [], [], []
    for seed in range(SEEDS):
        inputs, view = scene(scale, field, seed)
        with torch.no_grad():
            fast = render(*(x.float() for x in inputs), view, normals_as_features=False)
            slow = render_reference(*inputs, view)
        for k in PLANES:
            a, b = getattr(fast, k).double(), slow[k]
            if not float(b.abs().max()):
                continue
            relative = float((a - b).norm() / b.norm())
            (colour if k == "features" else other).append(relative)
            if k == "features":
                off.append(float(((a - b).abs() > 1e-4 * b.abs().max()).any(0).double().mean()))
    return max(colour, default=0.0), max(off, default=0.0), max(other, default=0.0)


def rows() -> list[Row]:
    """The whole grid."""
    return [Row(scale, angle, *errors(scale, angle)) for scale in SCALES for angle in FIELDS]


def main() -> None:
    """Measure, print and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--csv", type=Path, default=RESULTS)
    options = parser.parse_args()
    found = rows()
    write_rows(options.csv, found)
    for row in found:
        sys.stdout.write(f"{row.scale:g}, {row.field:g}°: {row.colour:.0e}, other planes {row.other:.0e}, {100 * row.off:.2g} % off\n")


if __name__ == "__main__":
    main()
