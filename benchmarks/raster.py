"""Time of the rasteriser in milliseconds, on a sphere of surfels that covers 56 % of the frame.

python -m benchmarks.raster --surfels 50000 --size 512 --channels 10 --json
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time

import torch

from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.raster.rasterise import render


def sphere(surfels: int, channels: int, size: int) -> tuple[list[torch.Tensor], Pinhole, torch.Tensor, torch.Tensor]:
    """Opaque, overlapping surfels evenly spread over the unit sphere, and a camera in which it covers 56 % of the frame."""
    generator = torch.Generator().manual_seed(0)
    i = torch.arange(surfels) + 0.5
    phi, z = i * math.pi * (3 - math.sqrt(5)), 1 - 2 * i / surfels
    r = (1 - z * z).sqrt()
    position = torch.stack([r * phi.cos(), r * phi.sin(), z], 1)
    # quaternion that rotates +z to the normal
    quaternion = torch.stack([1 + z, -position[:, 1], position[:, 0], torch.zeros_like(z)], 1)
    quaternion = quaternion / quaternion.norm(dim=1, keepdim=True).clamp_min(1e-6)
    spacing = math.sqrt(4 * math.pi / surfels)
    log_scale = torch.full((surfels, 2), math.log(0.7 * spacing))
    opacity = torch.full((surfels,), 0.9)
    features = torch.rand(surfels, channels, generator=generator)
    distance = 3.0
    silhouette = distance / math.sqrt(distance**2 - 1) / distance * distance  # tan of the half angle times distance
    focal = math.sqrt(0.56 / math.pi) * size / (silhouette / distance)
    pinhole = Pinhole(size, size, focal, focal, size / 2, size / 2)
    return [position, quaternion, log_scale, opacity, features], pinhole, torch.eye(3), torch.tensor([0.0, 0.0, distance])


def measure(surfels: int, size: int, channels: int, repeats: int = 9) -> dict[str, float]:
    """Median milliseconds of the forward pass (with projection, sort and binning) and the backward pass (with gradient reduction)."""
    inputs, pinhole, rotation, translation = sphere(surfels, channels, size)
    inputs = [x.requires_grad_() for x in inputs]
    forward, backward = [], []
    alpha = 0.0
    for _ in range(repeats + 2):
        start = time.perf_counter()
        out = render(*inputs, rotation, translation, pinhole, normals_as_features=False)
        mid = time.perf_counter()
        loss = out.features.sum() + out.depth.sum() + out.alpha.sum()
        late = time.perf_counter()
        loss.backward()
        end = time.perf_counter()
        forward.append(1e3 * (mid - start))
        backward.append(1e3 * (end - late))
        alpha = float(out.alpha.detach().mean())
        for x in inputs:
            x.grad = None
    return {
        "forward_ms": round(statistics.median(forward[2:]), 2),
        "backward_ms": round(statistics.median(backward[2:]), 2),
        "covered": round(alpha, 3),
    }


def main() -> None:
    """Parse the options and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--surfels", type=int, default=50_000)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--channels", type=int, default=10)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    figures = measure(args.surfels, args.size, args.channels)
    text = json.dumps(figures) if args.json else "  ".join(f"{k} {v}" for k, v in figures.items())
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
