"""A training run as a stage sees it: photos loaded, checkpoints kept, progress told, an interruption survived, results written."""

from __future__ import annotations

import csv
import os
import time
from typing import Any

import torch

from gsbake.capture.posed import PosedPhotos
from gsbake.pipeline.skip import leave_out
from gsbake.pipeline.stage import Context
from gsbake.splat.surfels import Surfels
from gsbake.splat.threads import configure
from gsbake.splat.trainer import Plan, Trainer
from gsbake.splat.views import held_out, load_views

CHECKPOINT_VERSION = 2
CHECKPOINT_SECONDS = 30.0


class Session:
    """Runs a `Trainer` to its end inside a stage's context."""

    def __init__(
        self, ctx: Context, posed: PosedPhotos, surfels: Surfels, light: Any, iterations: int, coarse_share: float, growth: str | None
    ) -> None:
        """Load the photos at `train.max_size`; go on from the newest checkpoint if this stage was interrupted.

        Surfels multiply by the rule `growth` of `policies.GROWING`; with None they neither come nor go.
        """
        self.ctx = ctx
        configure(ctx.threads)
        settings = ctx.settings
        with ctx.part("load photos"):
            full, half = ([view.to(ctx.device) for view in views] for views in load_views(posed, settings.train.max_size))
        held = held_out(len(full), settings.train.holdout)
        sections = settings.train, settings.splat, settings.loss
        plan = Plan(*sections, iterations, coarse_share, growth is not None, ctx.seed, settings.skip.converged, growth or "none")
        self.trainer = Trainer(plan, surfels.to(ctx.device), None if light is None else light.to(ctx.device), full, half, held)
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
            self.ctx.decide("training", f"resumed at step {self.trainer.done}", "a checkpoint of an interrupted run")

    def _save_checkpoint(self) -> None:
        path = self.ctx.checkpoint / "checkpoint.pt"
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            torch.save({"version": CHECKPOINT_VERSION, "trainer": self.trainer.state()}, file)
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
            while trainer.done < trainer.end:
                figures = trainer.step()
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
        return self._write()

    def _write(self) -> dict[str, Any]:
        trainer, out = self.trainer, self.ctx.out
        trainer.surfels.save(out / "surfels.safetensors")
        if trainer.light is not None:
            trainer.light.save(out / "light.safetensors")
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
