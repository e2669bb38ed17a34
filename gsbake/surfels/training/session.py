"""A training run from files to files: loads photos, keeps checkpoints, reports progress, survives interruption, writes results."""

from __future__ import annotations

import csv
import json
import os
import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Loss, Train
from gsbake.config.schema import Surfels as SurfelSettings
from gsbake.monitor import SILENT, Monitor, Rule, decide_skip
from gsbake.surfels.model import Surfels
from gsbake.surfels.raster.threads import configure
from gsbake.surfels.training.corrections import Correction
from gsbake.surfels.training.pose_refinement import Aligner
from gsbake.surfels.training.trainer import Plan, Trainer
from gsbake.surfels.training.views import held_out, load_views

CHECKPOINT_VERSION = 3
CHECKPOINT_SECONDS = 30.0
#: Logarithms of the exposure gains per photo and linear colour channel, beside the surfels.
EXPOSURE = "exposure.json"


@dataclass(frozen=True)
class TrainOptions:
    """Settings of a training run; `light_size` is the edge of the environment map's faces in texels, the rest are rules of [skip]."""

    train: Train = Train()
    model: SurfelSettings = SurfelSettings()
    loss: Loss = Loss()
    light_size: int = 32
    confirmed_steps: Rule = "auto"
    converged_steps: Rule = "auto"
    pose_refinement: Rule = "auto"
    exposure_refinement: Rule = "auto"


@dataclass(frozen=True)
class Execution:
    """Where and how a run takes place: the folder `out` for results, `scratch` for checkpoints (None: none are kept), seed, threads,
    device ("cpu" or "cuda") and monitor."""

    out: Path
    scratch: Path | None = None
    seed: int = 0
    threads: int = 2
    device: str = "cpu"
    monitor: Monitor = SILENT


class Session:
    """Runs a `Trainer` to its end."""

    def __init__(
        self,
        run: Execution,
        posed: PosedPhotos,
        surfels: Surfels,
        light: Any,
        options: TrainOptions,
        iterations: int,
        coarse_share: float,
        growth: str | None,
        trained: Path | None = None,
    ) -> None:
        """Load the photos at `train.max_size`; continue from the newest checkpoint of an interrupted run.

        `growth` is the densification policy of `policies.GROWING`; None neither densifies nor prunes. Poses and exposures are refined (as
        the options allow), unless an earlier run did that: `trained` is its folder, whose cameras `posed` has.
        """
        self.execution, self.posed, self.trained, self.options = run, posed, trained, options
        self.monitor = run.monitor
        configure(run.threads)
        with self.monitor.part("load photos"):
            full, half = ([view.to(run.device) for view in views] for views in load_views(posed, options.train.max_size))
        if trained is not None and (trained / EXPOSURE).exists():
            gains = json.loads((trained / EXPOSURE).read_text())["log_gains"]
            known = [Correction(torch.zeros(6).double(), torch.tensor(gains[view.name]).double()) for view in full]
            full, half = ([c.of(view) for view, c in zip(views, known, strict=True)] for views in (full, half))
        held = held_out(len(full), options.train.holdout)
        sections = options.train, options.model, options.loss
        plan = Plan(*sections, iterations, coarse_share, growth is not None, run.seed, options.converged_steps, growth or "none")
        self.trainer = Trainer(plan, surfels.to(run.device), None if light is None else light.to(run.device), full, half, held)
        self.aligner = None if trained else Aligner(self.trainer, options.pose_refinement, options.exposure_refinement)
        self.before = len(surfels)
        self.step_seconds = 0.0  # measured by `run`, evaluations included
        self._resume()

    @property
    def _checkpoint(self) -> Path | None:
        return None if self.execution.scratch is None else self.execution.scratch / "checkpoint.pt"

    def _resume(self) -> None:
        path = self._checkpoint
        if path is None or not path.exists():
            return
        body = torch.load(path, weights_only=True)
        if body["version"] == CHECKPOINT_VERSION:
            self.trainer.restore(body["trainer"])
            if self.aligner is not None:
                self.aligner.restore(body["aligner"])
            self.monitor.decide("training", f"resumed at step {self.trainer.done}", "checkpoint of an interrupted run")

    def _save_checkpoint(self) -> None:
        path = self._checkpoint
        if path is None:
            return
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            aligned = None if self.aligner is None else self.aligner.state()
            torch.save({"version": CHECKPOINT_VERSION, "trainer": self.trainer.state(), "aligner": aligned}, file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)

    def run(self) -> dict[str, Any]:
        """Train to the end (or to a requested stop, which leaves a checkpoint) and write the results."""
        trainer, monitor = self.trainer, self.monitor
        begun = saved = time.monotonic()
        first = trainer.done  # not 0 in a resumed run
        live: dict[str, float] = {}
        every = max(20, min(250, trainer.plan.iterations // 12))  # enough points for a curve, at little cost
        with monitor.part("train"):
            self._align()  # repeats a trial that was interrupted
            while trainer.done < trainer.end:
                figures = trainer.step()
                self._align()
                if trainer.done % every == 0 or trainer.done >= trainer.end:
                    live["psnr"] = trainer.record()["psnr"]
                monitor.progress(trainer.done, trainer.end, "", surfels=figures["surfels"], **live)
                if monitor.stop_requested():
                    self._save_checkpoint()
                    monitor.check_stop()
                if time.monotonic() - saved > CHECKPOINT_SECONDS:
                    self._save_checkpoint()
                    saved = time.monotonic()
        self.step_seconds = (time.monotonic() - begun) / max(1, trainer.done - first)
        self._report_decisions()
        return self._write()

    def _align(self) -> None:
        if self.aligner is not None:
            self.aligner.visit(self.monitor.stop_requested)

    def _report_decisions(self) -> None:
        """Report what was decided about early stopping, poses and exposures."""
        trainer, options = self.trainer, self.options
        total = trainer.plan.iterations
        spared = total - trainer.end
        stopped, seconds = f"stopped at step {trainer.end} of {total}", spared * self.step_seconds
        rule = options.converged_steps
        decide_skip(self.monitor, "converged_steps", rule, spared > 0, trainer.standing, stopped, f"all {total} steps", seconds)
        if self.aligner is None:
            return
        on, why = self.aligner.outcome, self.aligner.evidence
        decide_skip(self.monitor, "pose_refinement", options.pose_refinement, not on.poses, why, "poses kept", "poses refined")
        constant, learnt = "exposure taken as constant", "exposure gains learnt"
        decide_skip(self.monitor, "exposure_refinement", options.exposure_refinement, not on.gains, why, constant, learnt)

    def _write_corrections(self) -> None:
        """Write the current cameras and gains where they differ from those of the poses stage."""
        out = self.execution.out
        if self.trained is not None:
            for name in ("cameras.json", EXPOSURE):
                if (self.trained / name).exists():
                    shutil.copyfile(self.trained / name, out / name)
        elif self.aligner is not None:
            made, on = self.aligner.corrections, self.aligner.outcome
            given = self.posed.cameras
            if on.poses:
                cameras = tuple(c.camera(camera) for c, camera in zip(made, given.cameras, strict=True))
                replace(given, cameras=cameras).save(out / "cameras.json")
            if on.gains:
                gains = {camera.name: c.gain.tolist() for c, camera in zip(made, given.cameras, strict=True)}
                (out / EXPOSURE).write_text(json.dumps({"log_gains": gains}, indent=1))

    def _write(self) -> dict[str, Any]:
        trainer, out = self.trainer, self.execution.out
        trainer.surfels.save(out / "surfels.safetensors")
        if trainer.light is not None:
            trainer.light.save(out / "light.safetensors")
        self._write_corrections()
        with (out / "log.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, ["step", "psnr", "surfels", "sdf_median", "gamma"])
            writer.writeheader()
            writer.writerows(trainer.log)
        psnr = trainer.log[-1]["psnr"] if trainer.log else trainer.evaluate()
        return {
            "steps": trainer.done,
            "surfels_before": self.before,
            "surfels": len(trainer.surfels),
            "psnr": round(psnr, 3),
            "held_out": [trainer.views[i].name for i in trainer.held],
            "gamma": round(float(trainer.surfels.gamma), 4),
            "sdf_median": round(float(trainer.surfels.sdf.abs().median()), 6) if len(trainer.surfels) else None,
        }
