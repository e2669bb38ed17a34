"""Training and refinement of surfels from files to files: the work of the stages train and refine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Refine
from gsbake.monitor import SILENT, Monitor, decide_skip, skips
from gsbake.shading.environment import EnvironmentLight
from gsbake.surfels.densification.policies import growth
from gsbake.surfels.densification.refinement import prune_and_densify
from gsbake.surfels.initialisation import begin
from gsbake.surfels.model import Surfels
from gsbake.surfels.training.session import Execution, Session, TrainOptions
from gsbake.surfels.training.step_budget import settled_share, settles, spared_steps


@dataclass(frozen=True)
class RefineOptions:
    """Settings of refinement: the pruning, densification and iterations, and those of training that it continues with."""

    refine: Refine = Refine()
    training: TrainOptions = TrainOptions()


def train_surfels(
    poses: Path,
    out: Path,
    options: TrainOptions | None = None,
    *,
    stereo: Path | None = None,
    seed: int = 0,
    threads: int = 2,
    device: str = "cpu",
    scratch: Path | None = None,
    monitor: Monitor = SILENT,
) -> dict[str, Any]:
    """Initialise surfels, train them on the photos of the folder `poses`, write them into the folder `out`; return the figures.

    Written: `surfels.safetensors`, `log.csv`, with PBR shading `light.safetensors`, and where they were refined `cameras.json` and
    `exposure.json`. `stereo` is the folder that `run_stereo` wrote. A stop that `monitor` requests leaves a checkpoint in `scratch`, from
    which the next call continues with the same result. Raises InterruptedRun then.
    """
    options = options or TrainOptions()
    posed = PosedPhotos.open(poses)
    with monitor.part("start"):
        surfels, kind, why = begin(posed, options.train, options.model, seed, stereo)
        monitor.decide("initialisation", kind, why)
    rule, reason = growth(options.train.densify, kind)
    monitor.decide("densification", rule, reason)
    light = EnvironmentLight(options.light_size) if options.model.shading == "pbr" else None
    if light is None:
        monitor.decide("environment map", "none", "the profile trains plain colours")
    share = 0.0 if stereo is None else settled_share(posed, stereo)
    holds, evidence = settles(share, kind, light is not None)
    steps = options.train.iterations
    trusted = 1.0 if options.confirmed_steps == "always" else share
    spared = spared_steps(steps, trusted) if skips(options.confirmed_steps, holds) else 0
    run = Execution(out, scratch, seed, threads, device, monitor)
    session = Session(run, posed, surfels, light, options, steps - spared, options.train.coarse_share, rule)
    results = session.run()
    saved = spared * session.step_seconds
    skipped, done = f"{spared} of {steps} steps skipped", "no steps skipped"
    decide_skip(monitor, "confirmed_steps", options.confirmed_steps, holds, evidence, skipped, done, saved)
    return results


def refine_surfels(
    poses: Path,
    trained: Path,
    out: Path,
    options: RefineOptions | None = None,
    *,
    seed: int = 0,
    threads: int = 2,
    device: str = "cpu",
    scratch: Path | None = None,
    monitor: Monitor = SILENT,
) -> dict[str, Any]:
    """Prune, densify and fine-tune the surfels of the folder `trained`; write what `train_surfels` writes and return the figures.

    Raises BadInputError when pruning would leave nothing, InterruptedRun as `train_surfels`.
    """
    options = options or RefineOptions()
    posed = PosedPhotos.open(poses, trained)
    surfels = Surfels.load(trained / "surfels.safetensors")
    light = EnvironmentLight.load(trained / "light.safetensors") if (trained / "light.safetensors").exists() else None
    with monitor.part("prune and densify"):
        surfels, counts = prune_and_densify(surfels, posed, options.refine, options.training.train.max_size, seed)
    run = Execution(out, scratch, seed, threads, device, monitor)
    session = Session(run, posed, surfels, light, options.training, options.refine.iterations, 0.0, None, trained)
    return session.run() | {"counts": counts}
