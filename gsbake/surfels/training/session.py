"""A training run as a stage sees it: photos loaded, checkpoints kept, progress told, an interruption survived, results written."""

from __future__ import annotations

import csv
import json
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.pipeline.skip import leave_out
from gsbake.pipeline.stage import Context
from gsbake.surfels.model import Surfels
from gsbake.surfels.raster.threads import configure
from gsbake.surfels.training.corrections import Correction
from gsbake.surfels.training.pose_refinement import Aligner
from gsbake.surfels.training.trainer import Plan, Trainer
from gsbake.surfels.training.views import held_out, load_views

CHECKPOINT_VERSION = 3
CHECKPOINT_SECONDS = 30.0
#: Logs of the exposure gains per photo and linear colour channel, beside the surfels.
EXPOSURE = "exposure.json"


class Session:
    """Runs a `Trainer` to its end inside a stage's context."""

    def __init__(
        self,
        ctx: Context,
        posed: PosedPhotos,
        surfels: Surfels,
        light: Any,
        iterations: int,
        coarse_share: float,
        growth: str | None,
        trained: Path | None = None,
    ) -> None:
        """Load the photos at `train.max_size`; go on from the newest checkpoint if this stage was interrupted.

        Surfels multiply by the rule `growth` of `policies.GROWING`; with None they neither come nor go. Poses and exposures are refined
        (`[skip]` permitting), unless a stage already did that: `trained` is its folder, whose cameras `posed` has.
        """
        self.ctx, self.posed, self.trained = ctx, posed, trained
        configure(ctx.threads)
        settings = ctx.settings
        with ctx.part("load photos"):
            full, half = ([view.to(ctx.device) for view in views] for views in load_views(posed, settings.train.max_size))
        if trained is not None and (trained / EXPOSURE).exists():
            gains = json.loads((trained / EXPOSURE).read_text())["log_gains"]
            known = [Correction(torch.zeros(6).double(), torch.tensor(gains[view.name]).double()) for view in full]
            full, half = ([c.of(view) for view, c in zip(views, known, strict=True)] for views in (full, half))
        held = held_out(len(full), settings.train.holdout)
        sections = settings.train, settings.splat, settings.loss
        plan = Plan(*sections, iterations, coarse_share, growth is not None, ctx.seed, settings.skip.converged, growth or "none")
        self.trainer = Trainer(plan, surfels.to(ctx.device), None if light is None else light.to(ctx.device), full, half, held)
        self.aligner = None if trained else Aligner(self.trainer, settings.skip.refined_poses, settings.skip.refined_exposure)
        self.before = len(surfels)
        self.step_seconds = 0.0  # measured by `run`, evaluations included
        self._resume()

    def _resume(self) -> None:
        path = self.ctx.checkpoint / "checkpoint.pt"
        if not path.exists():
            return
        body = torch.load(path, weights_only=True)
        if body["version"] == CHECKPOINT_VERSION:
            self.trainer.restore(body["trainer"])
            if self.aligner is not None:
                self.aligner.restore(body["aligner"])
            self.ctx.decide("training", f"resumed at step {self.trainer.done}", "a checkpoint of an interrupted run")

    def _save_checkpoint(self) -> None:
        path = self.ctx.checkpoint / "checkpoint.pt"
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            aligned = None if self.aligner is None else self.aligner.state()
            torch.save({"version": CHECKPOINT_VERSION, "trainer": self.trainer.state(), "aligner": aligned}, file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)

    def run(self) -> dict[str, Any]:
        """Train to the end (or to a requested stop, which leaves a checkpoint) and write the results."""
        trainer, ctx = self.trainer, self.ctx
        begun = saved = time.monotonic()
        first = trainer.done  # not 0 in a resumed run
        live: dict[str, float] = {}
        every = max(20, min(250, trainer.plan.iterations // 12))  # a curve to look at, at little cost
        with ctx.part("train"):
            self._align()  # a trial that was given up for an interruption
            while trainer.done < trainer.end:
                figures = trainer.step()
                self._align()
                if trainer.done % every == 0 or trainer.done >= trainer.end:
                    live["psnr"] = trainer.record()["psnr"]
                ctx.progress(trainer.done, trainer.end, "", surfels=figures["surfels"], **live)
                if ctx.stop_requested():
                    self._save_checkpoint()
                    ctx.check_stop()
                if time.monotonic() - saved > CHECKPOINT_SECONDS:
                    self._save_checkpoint()
                    saved = time.monotonic()
        self.step_seconds = (time.monotonic() - begun) / max(1, trainer.done - first)
        spared = trainer.plan.iterations - trainer.end
        leave_out(
            ctx,
            "converged",
            spared > 0,
            trainer.standing,
            f"stopped at step {trainer.end} of {trainer.plan.iterations}",
            f"all {trainer.plan.iterations} steps",
            spared * self.step_seconds,
        )
        if self.aligner is not None:
            self._tell(self.aligner)
        return self._write()

    def _align(self) -> None:
        if self.aligner is not None:
            self.aligner.visit(self.ctx.stop_requested)

    def _tell(self, aligner: Aligner) -> None:
        """Log what was decided about poses and exposures."""
        on = aligner.outcome
        leave_out(self.ctx, "refined_poses", not on.poses, aligner.evidence, "poses kept", "poses refined")
        leave_out(self.ctx, "refined_exposure", not on.gains, aligner.evidence, "exposure taken as constant", "exposure gains learnt")

    def _write_corrections(self) -> None:
        """Write the cameras and gains in force, where they are not those of the poses stage."""
        out = self.ctx.out
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
        trainer, out = self.trainer, self.ctx.out
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
