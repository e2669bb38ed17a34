"""Training and refinement of surfels from folders to folders: the stages train and refine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Refine
from gsbake.monitor import SILENT, Monitor, decide_skip, skips
from gsbake.shading.environment import EnvironmentLight
from gsbake.surfels.densification.refinement import prune_and_densify
from gsbake.surfels.densification.registry import choose_densification
from gsbake.surfels.fields.registry import load_field, make_field
from gsbake.surfels.initialisation import initialise_surfels
from gsbake.surfels.model import Surfels
from gsbake.surfels.training.session import Execution, Schedule, Session, TrainOptions
from gsbake.surfels.training.step_budget import can_skip_steps, confirmed_share, skipped_steps


@dataclass(frozen=True)
class RefineOptions:
    """Settings of refinement: section [refine], and the training settings of its fine-tuning."""

    refine: Refine = Refine()
    training: TrainOptions = TrainOptions()


def train_surfels(
    poses: Path,
    out: Path,
    options: TrainOptions | None = None,
    *,
    stereo: Path | None = None,
    priors: tuple[Path | None, Path | None] = (None, None),
    seed: int = 0,
    threads: int = 2,
    device: str = "cpu",
    scratch: Path | None = None,
    monitor: Monitor = SILENT,
) -> dict[str, Any]:
    """Initialise surfels, train them on the photos of the folder `poses`, write them into the folder `out`; return the figures.

    Written: `surfels.safetensors`, `log.csv`, with PBR shading `light.safetensors`, with a continuous field `field.safetensors`, and where
    they were refined `cameras.json` and `exposure.json`. `stereo` is the folder that `run_stereo` wrote, `priors` are the folders of given
    normals and depths (`prior_maps`). A stop that `monitor` requests leaves a checkpoint in `scratch`, from
    which the next call continues with the same result. Raises InterruptedRun then.
    """
    options = options or TrainOptions()
    posed = PosedPhotos.open(poses)
    with monitor.part("initialisation"):
        surfels, kind, evidence = initialise_surfels(posed, options.train, options.model, seed, stereo)
        monitor.decide("initialisation", kind, evidence)
    policy, reason = choose_densification(options.train.densify, kind)
    monitor.decide("densification", policy, reason)
    light = EnvironmentLight(options.light_size) if options.model.shading == "pbr" else None
    if light is None:
        monitor.decide("environment map", "none", "colour shading (surfels.shading)")
    share = 0.0 if stereo is None else confirmed_share(posed, stereo)
    holds, evidence = can_skip_steps(share, kind, light is not None)
    steps = options.train.iterations
    assumed = 1.0 if options.confirmed_steps == "skip" else share
    skipped = skipped_steps(steps, assumed) if skips(options.confirmed_steps, holds) else 0
    run = Execution(out, scratch, seed, threads, device, monitor)
    with monitor.part("field"):
        field = make_field(surfels, options, seed)
    schedule = Schedule(steps - skipped, options.train.coarse_share, policy)
    session = Session(run, posed, surfels, light, options, schedule, field=field, priors=priors)
    results = session.run()
    saved, outcome = skipped * session.step_seconds, f"{skipped} of {steps} steps skipped"
    decide_skip(monitor, "confirmed_steps", options.confirmed_steps, holds, evidence, outcome, "no steps skipped", saved)
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
        field = load_field(trained, surfels, options.training, fine_tuning=True)
        surfels, counts = prune_and_densify(surfels, field, posed, options.refine, options.training.train.max_size, seed)
        field.follow(surfels)
    run = Execution(out, scratch, seed, threads, device, monitor)
    session = Session(run, posed, surfels, light, options.training, Schedule(options.refine.iterations, 0.0, None), trained, field)
    return session.run() | {"counts": counts}
