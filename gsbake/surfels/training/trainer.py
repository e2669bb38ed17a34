"""Training loop over photos: fits surfels, their SDF samples, materials and the environment map (Zhu et al., ICCV 2025).

The schedule is the paper's in shares of the run (of 30 000 steps: median, projection and distortion losses from 1 000, densification from
500 to 15 000), with the first part at half resolution. All state is in `state()`: a run resumed from a checkpoint gives the same result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsbake.imaging.metrics import decibels
from gsbake.monitor import Rule
from gsbake.surfels.adam import Adam
from gsbake.surfels.densification.clone_split import Statistics, densify, prune, reset_opacity
from gsbake.surfels.densification.policy import PolicyInputs
from gsbake.surfels.densification.registry import DENSIFICATION, PRUNING
from gsbake.surfels.densification.seeding import place_anew, seed_gaps
from gsbake.surfels.field import Field, TrainingStep
from gsbake.surfels.fields.samples import SamplesField
from gsbake.surfels.finite import first_non_finite
from gsbake.surfels.gbuffer import rasterise, rendered_image
from gsbake.surfels.losses.image import image_losses
from gsbake.surfels.losses.terms import ImageWeights
from gsbake.surfels.model import Surfels
from gsbake.surfels.raster.rasterise import Rendered
from gsbake.surfels.spacing import typical_spacing
from gsbake.surfels.training.early_stopping import has_plateaued
from gsbake.surfels.views import TrainView

#: Shares of the run: start of the SDF losses, start and end of densification.
SDF_START, DENSIFY_START, DENSIFY_END = 1 / 30, 1 / 60, 0.6
#: Minimum number of steps between densifications.
DENSIFY_INTERVAL = 100
#: Share of the run up to which opacity is reset.
RESET_END = 1 / 3
#: Share of the run in which learning rates decay after an early stop.
COOLDOWN_SHARE = 0.1
#: Surfels with a larger scale (unit frame) are pruned.
MAX_SCALE = 0.25


@dataclass(frozen=True)
class Plan:
    """Settings of a training run: the profile's sections and the schedule.

    `densify`: whether surfels are densified and pruned; `policy`: the densification policy, a name in `registry.DENSIFICATION`.
    `converged` is the rule skip.converged_steps: "auto" stops at a plateau, "skip" as soon as the schedule allows, "keep" does not stop
    early.
    """

    train: Any
    model: Any
    loss: Any
    iterations: int
    coarse_share: float
    densify: bool
    seed: int
    converged: Rule = "keep"
    policy: str = "gradient"


class Trainer:
    """State of the training; `step()` does one iteration and returns its figures."""

    def __init__(
        self,
        plan: Plan,
        surfels: Surfels,
        light: Any,
        views: list[TrainView],
        half_views: list[TrainView],
        validation_indices: list[int],
        test_indices: Sequence[int] = (),
        field: Field | None = None,
    ) -> None:
        """`views` and `half_views` are all photos at full and half training size; `validation_indices` those that decisions look at and
        `test_indices` those that nothing looks at, neither of them trained on; `light` is an `EnvironmentLight` or None; `field` is by
        default that of the surfels' own samples."""
        self.plan, self.surfels, self.light = plan, surfels, light
        self.field = field or SamplesField(surfels, plan.loss, plan.train)
        self.counts: dict[str, int] = {}
        self.views, self.half_views = views, half_views
        self.validation_indices = validation_indices
        self.training_indices = [i for i in range(len(views)) if i not in {*validation_indices, *test_indices}]
        self.adam = Adam()
        self.generator = torch.Generator().manual_seed(plan.seed)
        self.stats = Statistics.zeros(len(surfels), surfels.position.device)
        self.start_count = len(surfels)
        self.done = 0
        self.end = plan.iterations
        self.cooldown_start: int | None = None
        self.plateau_evidence = "not measured"
        self.queue: list[int] = []
        self.log: list[dict[str, float]] = []
        self.masked = all(v.mask is not None for v in views)
        self.background = torch.stack([v.colour().mean((1, 2)) for v in views]).mean(0)

    # -- iteration ----------------------------------------------------------------------------------------------------------------

    def _next_view(self) -> TrainView:
        if not self.queue:
            self.queue = [self.training_indices[i] for i in torch.randperm(len(self.training_indices), generator=self.generator).tolist()]
        index = self.queue.pop()
        return self.half_views[index] if self.coarse() else self.views[index]

    def coarse(self) -> bool:
        """Whether training is at half resolution."""
        return self.done < self.plan.coarse_share * self.plan.iterations

    def _background(self, view: TrainView) -> Tensor:
        """Background colour (3,) of render and photo: random in every step where there are masks, else the photos' mean."""
        if not self.masked:
            return self.background
        return torch.rand(3, generator=self.generator).to(view.rgb.device)

    def _loss(self, out: Rendered, view: TrainView, tables: Any) -> tuple[Tensor, Tensor]:
        """Weighted sum of all losses, and the colour loss alone."""
        w = self.plan.loss
        late = self.done >= SDF_START * self.plan.iterations
        weights = ImageWeights(w.ssim, w.normal, w.mask, w.distortion if late else 0.0, w.smoothness)
        total, colour = image_losses(out.planes, tables, view, self.masked, self._background(view), weights)
        if tables is not None and w.neutral_light:
            from gsbake.shading.neutral_light import neutral_light_loss

            total = total + w.neutral_light * neutral_light_loss(self.light.radiance())
        views = self.half_views if self.coarse() else self.views
        photos = [views[i] for i in self.training_indices]
        step = TrainingStep(self.surfels, out, self.done / max(1, self.plan.iterations), late, self.generator, photos)
        asked = self.field.losses(step, view)
        return total if asked is None else total + asked, colour

    def rates(self) -> dict[str, float]:
        """Adam's rate per tensor at this step: exponential decay of positions (to 1/100) and of materials and light (to 1/10)."""
        t, n = self.plan.train, self.plan.iterations
        share = self.done / max(1, n)
        if self.cooldown_start is not None:  # after an early stop the rest of the decay takes place in the cooldown
            start = self.cooldown_start / max(1, n)
            share = start + (1 - start) * (self.done - self.cooldown_start) / max(1, self.end - self.cooldown_start)
        slow, fast = 0.1**share, 0.01**share
        sdf, gamma = t.lr_sdf, t.lr_gamma
        if t.sharpness == "spacing":
            sdf, gamma = t.lr_sample * typical_spacing(self.surfels), t.lr_gamma * float(self.surfels.gamma.detach())
        rates = {
            "position": t.lr_position * fast, "quaternion": t.lr_rotation * slow, "log_scale": t.lr_scale * slow,
            "sdf": sdf * slow, "gamma": gamma * slow,
        }  # fmt: skip
        rates |= {f"attributes.{k}": t.lr_material * slow for k in self.surfels.attributes} | {"light": t.lr_light * slow}
        rates["attributes.opacity"] = t.lr_opacity * slow
        return rates | {f"field.{k}": rate * slow for k, rate in self.field.rates().items()}

    def step(self) -> dict[str, float]:
        """One iteration on one photo."""
        view = self._next_view()
        if self.field.advance(self.done / max(1, self.plan.iterations)):
            self.adam.forget([f"field.{k}" for k in self.field.parameters()])
        leaves = self.surfels.tensors() | {f"field.{k}": v for k, v in self.field.parameters().items()}
        for x in leaves.values():
            x.requires_grad_()
            x.grad = None
        tables = None
        if self.light is not None:
            for p in self.light.parameters():
                p.grad = None
            tables = self.light.prefilter()
        distance = self.field.distance(self.surfels) if self.plan.model.projected_depth else None
        out = rasterise(self.surfels, view, opacity=self.field.opacity(self.surfels), distance=distance)
        loss, colour = self._loss(out, view, tables)
        loss.backward()
        value = float(loss.detach())
        if not math.isfinite(value):
            lights = {} if self.light is None else {f"light.{k}": p for k, p in self.light.named_parameters()}
            what = first_non_finite(leaves | lights)
            cause = "" if what is None else f": {what} is not finite"
            raise FloatingPointError(f"the loss became {value} at step {self.done} on photo {view.name}{cause}")
        rates = self.rates()
        with torch.no_grad():
            grad = out.projected.grad
            assert grad is not None
            if "weight" in out.stats:
                self.stats.add(grad, out.stats["weight"], max(view.pinhole.width, view.pinhole.height))
            for name, x in leaves.items():
                if x.grad is not None:
                    self._update(name, x, rates[name], leaves)
                x.requires_grad_(False)
            self.surfels.gamma.clamp_min_(1e-3)
            if self.light is not None:
                for name, p in self.light.named_parameters():
                    if p.grad is not None:
                        self.adam.step(f"light.{name}", p.data, p.grad, rates["light"])
        self.done += 1
        self.field.settle(self.surfels)
        self._densify_and_prune()
        return {"loss": value, "colour": float(colour.detach()), "surfels": float(len(self.surfels))}

    def _update(self, name: str, x: Tensor, rate: float, leaves: dict[str, Tensor]) -> None:
        """One optimiser update. The error for a value that is not finite names its cause first: a tensor not updated yet, with the value
        that was rendered."""
        assert x.grad is not None
        try:
            self.adam.step(name, x, x.grad, rate)
        except FloatingPointError as effect:
            names = list(leaves)
            cause = first_non_finite({k: leaves[k] for k in names[names.index(name) + 1 :]})
            prefix = f"{cause} is not finite: " if cause else ""
            raise FloatingPointError(f"{prefix}{effect} (step {self.done})") from effect

    # -- densification and pruning ------------------------------------------------------------------------------------------------

    def _densify_and_prune(self) -> None:
        n = self.plan.iterations
        cycles = self.field.cycles if self.plan.densify else 0
        if cycles and self.done in {round(DENSIFY_END * n * (i + 1) / cycles) for i in range(cycles)}:
            self.surfels, placed = place_anew(self.surfels, self.adam, self.field, self.generator)
            self._count({"placed anew": placed})
            self.stats = Statistics.zeros(len(self.surfels), self.surfels.position.device)
            self.field.follow(self.surfels)
        interval = max(DENSIFY_INTERVAL, len(self.training_indices))  # statistics cover every photo
        if not self.plan.densify or self.done % interval or self.done < max(interval, DENSIFY_START * n):
            return
        if self.done > DENSIFY_END * n:
            return
        share = (self.done / n - DENSIFY_START) / (DENSIFY_END - DENSIFY_START)
        budget = int(self.start_count + (self.plan.model.max_count - self.start_count) * min(1.0, share))
        off = PRUNING[self.plan.train.prune](self._policy_inputs())
        self.surfels, keep, pruned = prune(self.surfels, self.adam, self.stats, MAX_SCALE, off)
        before = len(self.surfels)
        kept = Statistics(self.stats.gradient[keep], self.stats.views[keep], self.stats.weight[keep])
        large = float(self.surfels.scale.max(1).values.median()) if len(self.surfels) else 0.01
        score = DENSIFICATION[self.plan.policy](kept.mean_gradient(), self._policy_inputs())
        self.surfels = densify(self.surfels, self.adam, score, budget, large, self.generator)
        self._count({f"pruned, {k}": v for k, v in pruned.items()} | {"densified": len(self.surfels) - before})
        if self.field.seeds:
            self.field.follow(self.surfels)
            self.surfels, seeded = seed_gaps(self.surfels, self.adam, self.field, self.field.seeds, self.generator)
            self._count({"seeded": seeded})
        if self.plan.train.reset_opacity and self.done < RESET_END * n:
            self._count({"reset": reset_opacity(self.surfels, self.plan.train.reset_opacity)})
        self.stats = Statistics.zeros(len(self.surfels), self.surfels.position.device)
        self.field.follow(self.surfels)

    def _count(self, counts: dict[str, int]) -> None:
        for what, number in counts.items():
            self.counts[what] = self.counts.get(what, 0) + number

    @torch.no_grad()
    def _policy_inputs(self) -> PolicyInputs:
        return PolicyInputs.from_surfels(self.surfels, self.field.distance(self.surfels))

    # -- evaluation ---------------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def evaluate(self, max_views: int = 6) -> float:
        """PSNR in dB over validation photos (over training photos when there are none), inside the mask where there is one."""
        training = self.training_indices
        chosen = self.validation_indices[:max_views] or training[:: max(1, len(training) // max_views)][:max_views]
        views = self.half_views if self.coarse() else self.views
        tables = None if self.light is None else self.light.prefilter()
        total = []
        for i in chosen:
            view = views[i]
            out = rasterise(self.surfels, view)
            photo, mask = view.colour(), view.cover()
            cover = torch.ones_like(out.alpha) if mask is None or not self.masked else mask
            background = self.background[:, None, None]
            rendered = rendered_image(out.planes, view, tables) + background * (1 - out.alpha)
            error = (rendered - photo * cover - background * (1 - cover)) ** 2
            inside = (cover > 0.5) | (out.alpha > 0.5)
            total.append(decibels(float(error.mean(0)[inside].mean())))
        return sum(total) / len(total)

    def record(self) -> dict[str, float]:
        """Evaluate, append to the log, and decide on early stopping."""
        distance = self.field.distance(self.surfels).detach().abs()
        row = {
            "step": float(self.done), "psnr": self.evaluate(), "surfels": float(len(self.surfels)),
            "sdf_median": float(distance.median()) if len(self.surfels) else 0.0, "gamma": float(self.surfels.gamma),
        }  # fmt: skip
        self.log.append(row)
        densifying = self.plan.densify and self.done < DENSIFY_END * self.plan.iterations
        if self.plan.converged != "keep" and self.cooldown_start is None and self.done < self.end and not self.coarse() and not densifying:
            plateaued, self.plateau_evidence = has_plateaued(self.log)
            if plateaued or self.plan.converged == "skip":
                self.cooldown_start = self.done
                self.end = min(self.end, self.done + int(COOLDOWN_SHARE * self.plan.iterations))
        return row

    # -- checkpoints --------------------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """The state for a checkpoint."""
        return {
            "surfels": self.surfels.tensors(), "adam": self.adam.state(), "generator": self.generator.get_state(),
            "light": None if self.light is None else self.light.state_dict(), "queue": self.queue, "log": self.log, "done": self.done,
            "end": self.end, "cooling_from": self.cooldown_start, "standing": self.plateau_evidence, "start_count": self.start_count,
            "stats": (self.stats.gradient, self.stats.views, self.stats.weight), "field": self.field.state(),
            "counts": self.counts,
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self.surfels = Surfels.from_tensors(state["surfels"], self.surfels.transfer)
        self.adam.load(state["adam"])
        self.generator.set_state(state["generator"])
        if self.light is not None:
            self.light.load_state_dict(state["light"])
        self.queue, self.log, self.done, self.end = state["queue"], state["log"], state["done"], state["end"]
        self.cooldown_start, self.plateau_evidence, self.start_count = state["cooling_from"], state["standing"], state["start_count"]
        self.stats = Statistics(*state["stats"])
        self.field.restore(state["field"])
        self.counts = dict(state["counts"])
        self.field.follow(self.surfels)
