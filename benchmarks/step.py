"""Time of a training step by part: the rasteriser's kernels, the shading and the rest, in milliseconds.

python -m benchmarks.step [--materials] [--surfels 50000] [--size 512] [--threads 1]

The step is that of `Trainer` in the middle of a run (full resolution, all losses), on one photo of noise with a full mask and the sphere of
`benchmarks.raster`. Parts are timed where they are called: CPU time with one thread, wall time with more. Results are medians; `kernels`
is blending forward and backward with binning and the sum over slots, `rest` is the step without kernels and shading.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from benchmarks.raster import sphere
from gsbake.config.schema import Profile
from gsbake.kernels.threads import configure, thread_count
from gsbake.shading import light_tables as tables
from gsbake.shading import split_sum_kernel as light_kernels
from gsbake.shading.environment import EnvironmentLight
from gsbake.surfels import adam
from gsbake.surfels import spherical_harmonics as harmonics
from gsbake.surfels.densification import clone_split as adapt
from gsbake.surfels.losses import deferred_shading as deferred
from gsbake.surfels.losses import geometry, smoothness
from gsbake.surfels.losses import image as image_losses
from gsbake.surfels.losses import photometric as similarity
from gsbake.surfels.losses import projection as projection_losses
from gsbake.surfels.losses import terms as losses
from gsbake.surfels.model import Surfels, create
from gsbake.surfels.raster import projection
from gsbake.surfels.raster import rasterise as raster
from gsbake.surfels.training.trainer import Plan, Trainer
from gsbake.surfels.views import TrainView

#: Name in the table, owner and attribute of the timed function.
KERNELS = (("blend forward", raster._Blend, "forward"), ("blend backward", raster._Blend, "backward"))
SHADING = (("shading forward", light_kernels, "forward"), ("shading backward", light_kernels, "backward"))
REST = (
    ("projection forward", projection.Project, "forward"),
    ("projection backward", projection.Project, "backward"),
    ("opacity", Surfels, "opacity"),
    ("harmonics forward", harmonics._Colours, "forward"),
    ("harmonics backward", harmonics._Colours, "backward"),
    ("light filter forward", tables._Filter, "forward"),
    ("light filter backward", tables._Filter, "backward"),
    ("image losses", image_losses._ImageLosses, "forward"),
    (". colour and SSIM", similarity, "colour_loss"),
    (". normals, mask, distortion", geometry, "geometry_losses"),
    (". smoothness", smoothness, "smoothness_loss"),
    (". G-buffer forward, with shading", deferred.DeferredShading, "__init__"),
    (". G-buffer backward, with shading", deferred.DeferredShading, "backward"),
    ("projection loss forward", projection_losses._ProjectionLoss, "forward"),
    ("projection loss backward", projection_losses._ProjectionLoss, "backward"),
    ("median", losses, "median_sharpness"),
    ("Adam", adam.Adam, "step"),
    ("statistics", adapt.Statistics, "add"),
)


def trainer(surfels: int, size: int, materials: bool) -> Trainer:
    """A trainer in the middle of its run on the sphere of `benchmarks.raster`."""
    inputs, pinhole, rotation, translation = sphere(surfels, 3, size)
    points, iterations = inputs[0].numpy(), 1_000_000
    profile = Profile.model_validate({"train": {"iterations": iterations, "max_size": size}, "surfels": {"max_count": surfels}})
    photo = torch.randint(0, 256, (3, size, size), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    mask = torch.full((size, size), 255, dtype=torch.uint8)
    view = TrainView("noise", photo, mask, rotation, translation, -rotation.T @ translation, pinhole)
    state = create(points, points, np.ones(surfels), None, "pbr" if materials else "colour", 1, 0.01, 20.0)
    state.log_scale = inputs[2].clone()
    state.sdf = state.transfer.distance(inputs[3], state.gamma)
    light = EnvironmentLight(profile.light.size) if materials else None
    plan = Plan(profile.train, profile.surfels, profile.loss, iterations, 0.0, False, 0)
    made = Trainer(plan, state, light, [view], [view], [])
    made.done = iterations // 2
    return made


@contextmanager
def timed(clock: Callable[[], float], spent: dict[str, float]) -> Iterator[None]:
    """Add up in `spent` the seconds of every part inside the context."""
    originals: list[tuple[Any, str, Any]] = []
    for name, owner, attribute in (*KERNELS, *SHADING, *REST):
        inner = getattr(owner, attribute)

        def call(*args: Any, _inner: Any = inner, _name: str = name, **options: Any) -> Any:
            start = clock()
            try:
                return _inner(*args, **options)
            finally:
                spent[_name] = spent.get(_name, 0.0) + clock() - start

        originals.append((owner, attribute, owner.__dict__[attribute]))
        static = isinstance(originals[-1][2], staticmethod)
        setattr(owner, attribute, staticmethod(call) if static else call)
    try:
        yield
    finally:
        for owner, attribute, original in originals:
            setattr(owner, attribute, original)


def profile(surfels: int, size: int, materials: bool, repeats: int) -> dict[str, float]:
    """Median milliseconds by part, and of "step", "kernels", "shading" and "rest"."""
    clock = time.process_time if thread_count() == 1 else time.perf_counter
    made = trainer(surfels, size, materials)
    for _ in range(2):
        made.step()
    rounds: list[dict[str, float]] = []
    for _ in range(repeats):
        spent: dict[str, float] = {}
        with timed(clock, spent):
            start = clock()
            made.step()
            spent["step"] = clock() - start
        spent["kernels"] = sum(spent[k] for k, _, _ in KERNELS)
        spent["shading"] = sum(spent.get(k, 0.0) for k, _, _ in SHADING)
        spent["rest"] = spent["step"] - spent["kernels"] - spent["shading"]
        rounds.append(spent)
    return {k: 1e3 * statistics.median(r[k] for r in rounds) for k in rounds[0]}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--surfels", type=int, default=50_000)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--materials", action="store_true", help="PBR shading instead of colours")
    parser.add_argument("--repeats", type=int, default=11)
    parser.add_argument("--threads", type=int, default=thread_count())
    args = parser.parse_args()
    configure(args.threads)
    found = profile(args.surfels, args.size, args.materials, args.repeats)
    names = [name for name, _, _ in (*KERNELS, *SHADING, *REST) if name in found]
    for name in (*names, "kernels", "shading", "rest", "step"):
        sys.stdout.write(f"{name:36}{found[name]:8.2f} ms\n")
    sys.stdout.write(f"rest / kernels {found['rest'] / found['kernels']:.2f}\n")


if __name__ == "__main__":
    main()
