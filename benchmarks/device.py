"""Triton rasteriser on a GPU: parity with the CPU, a short training on both, and times beside gsplat's rasterization_2dgs.

python -m benchmarks.device [--check] [--csv results.csv]

gsplat (compared version: 1.5.3) has columns where it is installed.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import statistics
import sys
from collections.abc import Callable
from typing import Any

import torch

from benchmarks.csv_rows import current_commit, today
from benchmarks.raster import sphere
from gsbake.config.schema import Profile
from gsbake.pipeline.machine import missing_cuda_requirement
from gsbake.surfels.model import Surfels, quaternion_from_normal
from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.raster.rasterise import render
from gsbake.surfels.training.trainer import Plan, Trainer
from gsbake.surfels.transfer import transfer_by_name
from gsbake.surfels.views import TrainView

CHANNELS = 10
CASES = [(surfels, size) for surfels in (100_000, 1_000_000) for size in (800, 1600)]


def _norm_error(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).norm() / a.norm().clamp_min(1e-12))


def parity(surfels: int = 20_000, size: int = 400) -> dict[str, float]:
    """Relative error (Frobenius norm) of planes and gradients on the GPU against the Numba kernels on the CPU."""
    inputs, pinhole, rotation, translation = sphere(surfels, CHANNELS, size)
    results = []
    for device in ("cpu", "cuda"):
        leaves = [x.detach().to(device).requires_grad_() for x in (*inputs, rotation, translation)]
        out = render(*leaves, pinhole, normals_as_features=False)
        generator = torch.Generator().manual_seed(0)
        weights = {
            k: torch.randn(getattr(out, k).shape, generator=generator).to(device) for k in ("features", "depth", "distortion", "alpha")
        }
        sum((getattr(out, k) * w).sum() for k, w in weights.items()).backward()
        planes = {k: getattr(out, k).detach().cpu() for k in (*weights, "median")}
        names = ("position", "quaternion", "log_scale", "opacity", "features", "rotation", "translation")
        results.append(planes | {f"d {n}": x.grad.cpu() for n, x in zip(names, leaves, strict=True)})
    return {k: _norm_error(results[0][k], results[1][k]) for k in results[0]}


def training(steps: int = 200, size: int = 128) -> dict[str, float]:
    """PSNR after a short training on renders of a striped ball, on both devices from the same initialisation."""
    inputs, pinhole, _, _ = sphere(3000, 3, size)
    colours = 0.5 + 0.4 * torch.sin(6 * inputs[0].roll(1, 1))
    views, generator = [], torch.Generator().manual_seed(0)
    for i in range(8):
        turn = torch.linalg.qr(torch.randn(3, 3, generator=generator))[0]
        turn = turn * torch.det(turn).sign()
        t = torch.tensor([0.0, 0.0, 3.0])
        out = render(*inputs[:4], colours, turn, t, pinhole, normals_as_features=False)
        rgb, mask = ((255 * x).clamp(0, 255).byte() for x in (out.features, out.alpha))
        views.append(TrainView(f"{i}", rgb, mask, turn, t, -turn.T @ t, pinhole))
    profile = Profile()
    plan = Plan(profile.train, profile.surfels, profile.loss, steps, 0.0, False, 0)
    found = {}
    for device in ("cpu", "cuda"):
        start = Surfels(
            inputs[0].clone(), quaternion_from_normal(inputs[0]), inputs[2].clone(), torch.full((3000,), 0.01), torch.tensor([1.0]),
            {"sh": torch.zeros(3000, 1, 3)}, transfer_by_name("sech2"),
        )  # fmt: skip
        moved = [v.to(device) for v in views]
        trainer = Trainer(plan, start.to(device), None, moved, moved, [])
        while trainer.done < trainer.end:
            trainer.step()
        found[device] = trainer.evaluate()
    return found


def _milliseconds(call: Callable[[], Any], backward: Callable[[Any], torch.Tensor], repeats: int = 12) -> tuple[float, float]:
    """Median milliseconds of forward and backward by CUDA events, after three warm-up rounds."""
    times: list[tuple[float, float]] = []
    for _ in range(repeats + 3):
        a, b, c, d = (torch.cuda.Event(enable_timing=True) for _ in range(4))
        a.record()
        out = call()
        b.record()
        loss = backward(out)
        c.record()
        loss.backward()
        d.record()
        torch.cuda.synchronize()
        times.append((a.elapsed_time(b), c.elapsed_time(d)))
    forward, back = zip(*times[3:], strict=True)
    return statistics.median(forward), statistics.median(back)


def _gsplat(leaves: list[torch.Tensor], rotation: torch.Tensor, translation: torch.Tensor, pinhole: Pinhole) -> tuple[float, float]:
    from gsplat import rasterization_2dgs

    position, quaternion, log_scale, opacity, features = leaves
    pose = torch.eye(4, device="cuda")
    pose[:3, :3], pose[:3, 3] = rotation, translation
    k = torch.tensor([[pinhole.fx, 0, pinhole.cx], [0, pinhole.fy, pinhole.cy], [0, 0, 1]], device="cuda")

    def call() -> Any:
        scale = torch.cat([log_scale.exp(), torch.ones_like(log_scale[:, :1])], 1)
        return rasterization_2dgs(
            position, quaternion, scale, opacity, features, pose[None], k[None], pinhole.width, pinhole.height, render_mode="RGB+D"
        )

    return _milliseconds(call, lambda out: out[0].sum() + out[1].sum())


def timings(surfels: int, size: int, peer: bool) -> dict[str, float]:
    """One row of the table: milliseconds of forward and backward (with projection, sort and reduction), peak memory, gsplat's times."""
    inputs, pinhole, rotation, translation = sphere(surfels, CHANNELS, size)
    leaves = [x.detach().cuda().requires_grad_() for x in inputs]
    rotation, translation = rotation.cuda(), translation.cuda()
    torch.cuda.reset_peak_memory_stats()
    forward, backward = _milliseconds(
        lambda: render(*leaves, rotation, translation, pinhole, normals_as_features=False),
        lambda out: out.features.sum() + out.depth.sum() + out.alpha.sum(),
    )
    row = {
        "surfels": surfels,
        "size": size,
        "forward_ms": forward,
        "backward_ms": backward,
        "peak_mb": torch.cuda.max_memory_allocated() / 1e6,
    }
    if peer:
        theirs = _gsplat(leaves, rotation, translation, pinhole)
        row |= {"gsplat_forward_ms": theirs[0], "gsplat_backward_ms": theirs[1], "speed": sum(theirs) / (forward + backward)}
    return row


def main() -> int:
    """Run checks and timings; exit code 2 without a GPU, 1 when a check fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="parity and training only, no timings")
    parser.add_argument("--csv", help="write the timings to this file too")
    args = parser.parse_args()
    lacks = missing_cuda_requirement()
    if lacks:
        sys.stderr.write(f"benchmarks.device needs an NVIDIA GPU: {lacks}.\n")
        return 2
    print(torch.cuda.get_device_name(), "torch", torch.__version__)
    errors = parity()
    print("relative error against the CPU:", "  ".join(f"{k} {v:.1e}" for k, v in errors.items()))
    psnr = training()
    print("PSNR after a short training:", "  ".join(f"{k} {v:.2f} dB" for k, v in psnr.items()))
    if max(errors.values()) > 5e-3 or abs(psnr["cpu"] - psnr["cuda"]) > 0.5:
        sys.stderr.write("The results on GPU and CPU differ.\n")
        return 1
    if args.check:
        return 0
    peer = importlib.util.find_spec("gsplat") is not None
    rows = [timings(surfels, size, peer) for surfels, size in CASES]
    print("  ".join(f"{k:>18}" for k in rows[0]))
    for row in rows:
        print("  ".join(f"{v:18.2f}" for v in row.values()))
    if args.csv:
        with open(args.csv, "w", newline="") as file:
            origin = {"commit": current_commit(), "host": f"{torch.cuda.get_device_name()}, torch {torch.__version__}", "date": today()}
            writer = csv.DictWriter(file, [*rows[0], *origin])
            writer.writeheader()
            writer.writerows(row | origin for row in rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
