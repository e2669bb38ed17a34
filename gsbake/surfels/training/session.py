"""A training run: loads photos, trains, reports progress, writes checkpoints and results, resumes after interruption."""

from __future__ import annotations

import csv
import json
import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gsbake.capture.photos.roles import test_photos, validation_photos
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.checkpoint import DamagedCheckpointError, load_checkpoint, save_checkpoint
from gsbake.config.schema import Coupling, DistanceField, Loss, Train
from gsbake.config.schema import Surfels as SurfelSettings
from gsbake.kernels.threads import configure
from gsbake.monitor import SILENT, Monitor, Rule, decide_skip
from gsbake.surfels.field import Field
from gsbake.surfels.fields.registry import save_field
from gsbake.surfels.model import Surfels
from gsbake.surfels.training.corrections import Correction
from gsbake.surfels.training.photos import exposure_spread, load_views
from gsbake.surfels.training.pose_refinement import Aligner, exposure_rule, pose_rule
from gsbake.surfels.training.prior_maps import add_priors
from gsbake.surfels.training.trainer import Plan, Trainer

#: Checkpoints of other versions are ignored.
CHECKPOINT_VERSION = 5
#: Interval between checkpoints.
CHECKPOINT_SECONDS = 30.0
#: File with the logarithms of the exposure gains per photo and linear colour channel.
EXPOSURE = "exposure.json"


@dataclass(frozen=True)
class TrainOptions:
    """Settings of a training run; `light_size` is the edge of the environment map's faces in texels, the rules are those of [skip]."""

    train: Train = Train()
    model: SurfelSettings = SurfelSettings()
    loss: Loss = Loss()
    light_size: int = 32
    confirmed_steps: Rule = "auto"
    converged_steps: Rule = "auto"
    pose_refinement: Rule = "auto"
    exposure_refinement: Rule = "auto"
    field: DistanceField = DistanceField()
    coupling: Coupling = Coupling()


@dataclass(frozen=True)
class Execution:
    """Execution of a run: folder `out` for results, `scratch` for checkpoints (None: no checkpoints), seed, threads, device ("cpu" or
    "cuda") and monitor."""

    out: Path
    scratch: Path | None = None
    seed: int = 0
    threads: int = 2
    device: str = "cpu"
    monitor: Monitor = SILENT


@dataclass(frozen=True)
class Schedule:
    """Number of `iterations`, the share of them at half resolution, and the densification `policy`, a name in `registry.DENSIFICATION`
    (None: neither densification nor pruning)."""

    iterations: int
    coarse_share: float
    policy: str | None


class Session:
    """Runs a `Trainer` to its end."""

    def __init__(
        self,
        run: Execution,
        posed: PosedPhotos,
        surfels: Surfels,
        light: Any,
        options: TrainOptions,
        schedule: Schedule,
        trained: Path | None = None,
        field: Field | None = None,
        priors: tuple[Path | None, Path | None] = (None, None),
    ) -> None:
        """Load the photos at `train.max_size`; resume from the checkpoint of an interrupted run.

        Poses and exposures are refined (as the options allow), unless an earlier run did that: `trained` is its folder, whose cameras
        `posed` has. `priors` are the folders of given normals and depths.
        """
        self.execution, self.posed, self.trained, self.options = run, posed, trained, options
        self.monitor = run.monitor
        configure(run.threads)
        with self.monitor.part("load photos"):
            loaded = (add_priors(views, posed.cameras, posed.folder, *priors) for views in load_views(posed, options.train.max_size))
            full, half = ([view.to(run.device) for view in views] for views in loaded)
        if trained is not None and (trained / EXPOSURE).exists():
            gains = json.loads((trained / EXPOSURE).read_text(encoding="utf-8"))["log_gains"]
            exposure = [Correction(torch.zeros(6).double(), torch.tensor(gains[view.name]).double()) for view in full]
            full, half = ([c.apply(view) for view, c in zip(views, exposure, strict=True)] for views in (full, half))
        validation, test = (roles(len(full), options.train.holdout) for roles in (validation_photos, test_photos))
        sections = options.train, options.model, options.loss
        policy = schedule.policy
        plan = Plan(
            *sections, schedule.iterations, schedule.coarse_share, policy is not None, run.seed, options.converged_steps, policy or "none"
        )
        light = None if light is None else light.to(run.device)
        self.trainer = Trainer(plan, surfels.to(run.device), light, full, half, validation, test, field)
        self.aligner = None
        if trained is None:
            poses, self.poses_kept = pose_rule(options.pose_refinement, posed.cameras, max(full[0].rgb.shape[1:]))
            spread = exposure_spread(posed, full) if options.exposure_refinement == "auto" else None
            gains, self.exposures_kept = exposure_rule(options.exposure_refinement, spread)
            self.aligner = Aligner(self.trainer, poses, gains)
        self.before = len(surfels)
        self.step_seconds = 0.0  # measured by `run`, evaluations included
        self._resume()

    @property
    def _checkpoint(self) -> Path | None:
        return None if self.execution.scratch is None else self.execution.scratch / "checkpoint.safetensors"

    def _resume(self) -> None:
        path = self._checkpoint
        if path is None or not path.exists():
            return
        try:
            body = load_checkpoint(path)
        except DamagedCheckpointError as error:
            self.monitor.warn(f"The checkpoint of the interrupted run is damaged ({error}); training starts over.")
            path.unlink(missing_ok=True)
            return
        if body["version"] == CHECKPOINT_VERSION:
            self.trainer.restore(body["trainer"])
            if self.aligner is not None:
                self.aligner.restore(body["aligner"])
            self.monitor.decide("training", f"resumed at step {self.trainer.done}", "checkpoint of an interrupted run")

    def _save_checkpoint(self) -> None:
        path = self._checkpoint
        if path is None:
            return
        aligned = None if self.aligner is None else self.aligner.state()
        save_checkpoint(path, {"version": CHECKPOINT_VERSION, "trainer": self.trainer.state(), "aligner": aligned})

    def run(self) -> dict[str, Any]:
        """Train to the end (or to a requested stop, which writes a checkpoint) and write the results."""
        trainer, monitor = self.trainer, self.monitor
        started = saved = time.monotonic()
        first = trainer.done  # not 0 after a resume
        live: dict[str, float] = {}
        interval = max(20, min(250, trainer.plan.iterations // 12))  # of evaluations: enough for a curve, at little cost
        with monitor.part("training"):
            self._align()  # repeats a trial that was interrupted
            while trainer.done < trainer.end:
                figures = trainer.step()
                self._align()
                if trainer.done % interval == 0 or trainer.done >= trainer.end:
                    live["psnr"] = trainer.record()["psnr"]
                monitor.progress(trainer.done, trainer.end, "", surfels=figures["surfels"], **live)
                if monitor.stop_requested():
                    self._save_checkpoint()
                    monitor.check_stop()
                if time.monotonic() - saved > CHECKPOINT_SECONDS:
                    self._save_checkpoint()
                    saved = time.monotonic()
        self.step_seconds = (time.monotonic() - started) / max(1, trainer.done - first)
        self._report_decisions()
        return self._write()

    def _align(self) -> None:
        if self.aligner is not None:
            self.aligner.update(self.monitor.stop_requested)

    def _report_decisions(self) -> None:
        """Report the decisions on early stopping, poses and exposures."""
        trainer, options = self.trainer, self.options
        total = trainer.plan.iterations
        skipped = total - trainer.end
        stopped, seconds = f"stopped at step {trainer.end} of {total}", skipped * self.step_seconds
        rule = options.converged_steps
        decide_skip(self.monitor, "converged_steps", rule, skipped > 0, trainer.plateau_evidence, stopped, f"all {total} steps", seconds)
        if self.aligner is None:
            return
        kinds, evidence = self.aligner.decision, self.aligner.evidence
        reason = self.poses_kept or evidence
        decide_skip(self.monitor, "pose_refinement", options.pose_refinement, not kinds.poses, reason, "poses kept", "poses refined")
        reason, constant, learnt = self.exposures_kept or evidence, "constant exposure", "exposure gains learnt"
        decide_skip(self.monitor, "exposure_refinement", options.exposure_refinement, not kinds.gains, reason, constant, learnt)

    def _write_corrections(self) -> None:
        """Write cameras and exposure gains where they differ from those of the poses stage."""
        out = self.execution.out
        if self.trained is not None:
            for name in ("cameras.json", EXPOSURE):
                if (self.trained / name).exists():
                    shutil.copyfile(self.trained / name, out / name)
        elif self.aligner is not None:
            corrections, kinds = self.aligner.corrections, self.aligner.decision
            given = self.posed.cameras
            if kinds.poses:
                cameras = tuple(c.apply_to_camera(camera) for c, camera in zip(corrections, given.cameras, strict=True))
                replace(given, cameras=cameras).save(out / "cameras.json")
            if kinds.gains:
                gains = {camera.name: c.gain.tolist() for c, camera in zip(corrections, given.cameras, strict=True)}
                (out / EXPOSURE).write_bytes(json.dumps({"log_gains": gains}, indent=1).encode())

    def _write(self) -> dict[str, Any]:
        trainer, out = self.trainer, self.execution.out
        with torch.no_grad():
            trainer.field.distance(trainer.surfels)
            trainer.field.settle(trainer.surfels)
        trainer.surfels.save(out / "surfels.safetensors")
        save_field(out, trainer.field)
        if trainer.light is not None:
            trainer.light.save(out / "light.safetensors")
        self._write_corrections()
        with (out / "log.csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, ["step", "psnr", "surfels", "sdf_median", "gamma"])
            writer.writeheader()
            writer.writerows(trainer.log)
        psnr = trainer.log[-1]["psnr"] if trainer.log else trainer.evaluate()
        return {
            "steps": trainer.done,
            "surfels_before": self.before,
            "surfels": len(trainer.surfels),
            "psnr": round(psnr, 3),
            "validation": [trainer.views[i].name for i in trainer.validation_indices],
            "gamma": round(float(trainer.surfels.gamma), 4),
            "densification": dict(trainer.counts),
            "sdf_median": round(float(trainer.surfels.sdf.abs().median()), 6) if len(trainer.surfels) else None,
        }
