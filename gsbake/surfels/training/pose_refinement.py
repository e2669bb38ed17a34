"""Pose and exposure refinement during training, decided by a trial on validation photos.

Held-out photos are aligned to the surfels on half of their pixels (squares of a checkerboard). This measures pose and exposure errors and,
on the other half, how well surfels fit the photos once aligned (PSNR). Large errors start a trial: the same steps with and without
corrected photos; the run with the higher PSNR continues. Corrections alternate with training (block coordinate descent); `align`
computes each of them with the surfels frozen. Poses are tried only where matched features contradict them, and exposures where photos
differ at tie points: surfels cannot tell a wrong camera or another exposure from reflections that move over a glossy object.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsbake.capture.exposure import MAX_SPREAD
from gsbake.geometry.cameras import CameraSet
from gsbake.monitor import Rule
from gsbake.surfels.training import alignment as align
from gsbake.surfels.training.corrections import Correction, CorrectionKinds, remove_gauge
from gsbake.surfels.training.trainer import Trainer

#: Share of the run before the first correction, and between corrections (at least one step per training photo).
START_SHARE, INTERVAL_SHARE = 0.3, 0.05
#: Steps of a trial, as a share of the run; at least one per photo. Better poses need that long to improve surfels
#: (docs/decisions/0015-poses-kept.md).
TRIAL_SHARE = 0.3
#: Minimum pose error for a trial in pixels and as a share of the longer side (median over held-out photos): with exact poses, unfinished
#: surfels measure .2 to .9 pixels of 400.
MIN_MOTION, MIN_MOTION_SHARE = 1.5, 1.5 / 400
#: Median Sampson distance of matches by the root mean square error in pixels of both photos' poses, where these are normally distributed.
EPIPOLAR_SHARE = 0.48
#: Minimum exposure error for a trial: root mean square of the log gains.
MIN_LOG_GAIN = 0.08
#: A trial succeeds with this mean gain of held-out PSNR (dB) and this share of improved photos.
MIN_PSNR_GAIN, MIN_IMPROVED_SHARE = 0.1, 0.6
#: Maximum number of photos measured, and the edge of the checkerboard's squares in pixels.
MAX_MEASURED_PHOTOS, CHECKER_SIZE = 8, 16
#: Blurs of `align` for photos that were corrected before.
REFINED_BLURS = (1.0,)


@dataclass(frozen=True)
class AlignmentResult:
    """Alignment of k photos: `psnr` (k,) in dB on pixels that the alignment does not use, `motion` (k,) in pixels, log `gain` (k, 3)."""

    psnr: Tensor
    motion: Tensor
    gain: Tensor


def motion_bound(size: int) -> float:
    """Minimum pose error for a trial in pixels of photos whose longer side is `size`."""
    return max(MIN_MOTION, MIN_MOTION_SHARE * size)


def needs_trial(measured: AlignmentResult, size: int) -> tuple[CorrectionKinds, str]:
    """Which corrections need a trial, and the evidence; `size` is the photos' longer side in pixels."""
    motion, threshold = float(measured.motion.median()), motion_bound(size)
    gain = float((measured.gain - measured.gain.mean(0)).square().mean().sqrt())
    errors = f"pose error {motion:.1f} px, exposure error {100 * gain:.0f} %"
    evidence = f"{errors}; a trial needs {threshold:.2g} px or {100 * MIN_LOG_GAIN:g} %"
    return CorrectionKinds(motion >= threshold, gain >= MIN_LOG_GAIN), evidence


def trial_improves(before: Tensor, after: Tensor) -> tuple[bool, str]:
    """Whether a trial improves held-out photos, and the evidence; `before` and `after` (k,) are PSNR in dB."""
    gain = after - before
    holds = float(gain.mean()) >= MIN_PSNR_GAIN and float((gain > 0).double().mean()) >= MIN_IMPROVED_SHARE
    return holds, f"a trial gained {float(gain.mean()):+.2f} dB on validation photos; {MIN_PSNR_GAIN:g} dB are needed"


def pose_rule(rule: Rule, cameras: CameraSet, size: int) -> tuple[Rule, str]:
    """The `rule` of pose refinement for these `cameras`, and the reason where it differs; `size` is the longer side of training photos.

    Structure from motion has minimised its poses' errors already; given poses are kept unless matched features contradict them.
    """
    if rule != "auto":
        return rule, ""
    if cameras.poses == "solved":
        return "skip", "the poses are those of structure from motion"
    if cameras.epipolar_px is None:
        return "skip", "too few features were matched to tell whether the given poses are wrong"
    error = cameras.epipolar_px * size / max(max(camera.width, camera.height) for camera in cameras.cameras)
    limit = EPIPOLAR_SHARE * motion_bound(size)
    if error < limit:
        return "skip", f"matched features are {error:.2f} px from the epipolar lines of the given poses; a trial needs {limit:.2g} px"
    return "auto", ""


def exposure_rule(rule: Rule, spread: float | None) -> tuple[Rule, str]:
    """The `rule` of exposure refinement for photos with this `spread` of tie points (`capture.exposure`, None: too few of them), and
    the reason where it differs."""
    if rule != "auto":
        return rule, ""
    if spread is None:
        return "skip", "too few tie points to tell whether photos differ in exposure"
    if spread < MAX_SPREAD:
        return "skip", f"90 % of the photos agree within {spread:.2f}x at their tie points; a trial needs {MAX_SPREAD:g}x"
    return "auto", ""


class Aligner:
    """Corrects the poses and exposures of a trainer's photos."""

    def __init__(self, trainer: Trainer, poses: Rule, gains: Rule) -> None:
        """Rules of [skip] for `poses` and `gains`: "skip" leaves these corrections out, "keep" makes them, "auto" decides by a trial."""
        self.trainer, self.required = trainer, CorrectionKinds(poses == "keep", gains == "keep")
        self.allowed = CorrectionKinds(poses != "skip", gains != "skip")
        self.original = list(trainer.views), list(trainer.half_views)
        self.corrections = [Correction.identity() for _ in trainer.views]
        self.decided = None if "auto" in (poses, gains) else self.required
        self.evidence = "not measured"
        self.corrected_at = -1

    def update(self, stopped: Callable[[], bool]) -> None:
        """Decide, or correct the photos, when they are due; a trial is discarded, to be repeated, when `stopped()` is true."""
        done, n, end = self.trainer.done, self.trainer.plan.iterations, self.trainer.end
        if done < START_SHARE * n or done == self.corrected_at:
            return
        if self.decided is None:
            self._decide(stopped)
        elif self.decided:
            interval = max(len(self.trainer.training_indices), INTERVAL_SHARE * n)
            if self.corrected_at < 0 or done == end or done - self.corrected_at >= interval:
                self.correct(self.decided)

    @property
    def decision(self) -> CorrectionKinds:
        """What is corrected; nothing while undecided."""
        return self.decided or CorrectionKinds(False, False)

    # -- deciding -----------------------------------------------------------------------------------------------------------------

    def _scene(self) -> align.Scene:
        t = self.trainer
        return align.make_scene(t.surfels, t.light, t.masked, t.background)

    def measure(self, what: CorrectionKinds) -> AlignmentResult:
        """Align validation photos (training photos where there are none) on half of their pixels and compare the other half."""
        t = self.trainer
        pool = t.validation_indices or t.training_indices
        scene, rows = self._scene(), []
        for i in pool[:: -(-len(pool) // MAX_MEASURED_PHOTOS)]:
            view = t.views[i]
            h, w = view.rgb.shape[1:]
            y, x = torch.arange(h, device=view.rgb.device) // CHECKER_SIZE, torch.arange(w, device=view.rgb.device) // CHECKER_SIZE
            even = (y[:, None] + x) % 2 == 0
            fit = align.align(scene, view, Correction.identity(), what, even)
            rows.append((align.psnr(scene, view, fit, ~even), align.rms_motion(scene, view, fit), fit.gain))
        return AlignmentResult(torch.tensor([r[0] for r in rows]), torch.tensor([r[1] for r in rows]), torch.stack([r[2] for r in rows]))

    def _decide(self, stopped: Callable[[], bool]) -> None:
        """Measure the errors and, where they are large, run the trial; `decided` stays None when it is stopped."""
        size = max(self.trainer.views[0].rgb.shape[1:])
        promising, self.evidence = needs_trial(self.measure(CorrectionKinds(True, True)), size)
        poses = self.required.poses or (self.allowed.poses and promising.poses)
        what = CorrectionKinds(poses, self.required.gains or (self.allowed.gains and promising.gains))
        if what == self.required:
            self.decided = what
            return
        trainer, steps = self.trainer, max(len(self.trainer.training_indices), round(TRIAL_SHARE * self.trainer.plan.iterations))
        initial = copy.deepcopy(trainer.state())
        self.correct(what)
        corrected_state = self._train(steps, stopped)
        after, corrections = self.measure(what), self.corrections
        self._restore(initial, [Correction.identity() for _ in corrections])
        if corrected_state is None:
            return
        without = self._train(steps, stopped)
        before = self.measure(what)
        if without is None:
            self._restore(initial, self.corrections)
            return
        holds, evidence = trial_improves(before.psnr, after.psnr)
        self.evidence = f"{self.evidence}: {evidence}"
        self.decided = what if holds else self.required
        if holds:
            self._restore(corrected_state, corrections)
        self.corrected_at = trainer.done

    def _train(self, steps: int, stopped: Callable[[], bool]) -> dict[str, Any] | None:
        """Train for `steps` more; return the state, or None when stopped."""
        for _ in range(min(steps, self.trainer.end - self.trainer.done)):
            if stopped():
                return None
            self.trainer.step()
        return copy.deepcopy(self.trainer.state())

    # -- correcting ---------------------------------------------------------------------------------------------------------------

    def correct(self, what: CorrectionKinds) -> None:
        """Align all photos to the current surfels, starting from their current corrections."""
        scene, blurs = self._scene(), align.BLURS if self.corrected_at < 0 else REFINED_BLURS
        views = self.original[0]
        found = [align.align(scene, v, c, what, None, blurs) for v, c in zip(views, self.corrections, strict=True)]
        self._apply(remove_gauge(views, found))
        self.corrected_at = self.trainer.done

    def _apply(self, corrections: list[Correction]) -> None:
        self.corrections = corrections
        for views, original in zip((self.trainer.views, self.trainer.half_views), self.original, strict=True):
            views[:] = [c.apply(v) for v, c in zip(original, corrections, strict=True)]

    # -- checkpoints --------------------------------------------------------------------------------------------------------------

    def _restore(self, state: dict[str, Any], corrections: list[Correction]) -> None:
        self.trainer.restore(copy.deepcopy(state))
        self._apply(corrections)
        self.corrected_at = -1

    def state(self) -> dict[str, Any]:
        """The state for a checkpoint."""
        decided = None if self.decided is None else (self.decided.poses, self.decided.gains)
        table = torch.stack([torch.cat([c.twist, c.gain]) for c in self.corrections])
        return {"on": decided, "corrections": table, "evidence": self.evidence, "corrected_at": self.corrected_at}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self.decided = None if state["on"] is None else CorrectionKinds(*state["on"])
        self.evidence, self.corrected_at = state["evidence"], state["corrected_at"]
        self._apply([Correction(row[:6].clone(), row[6:].clone()) for row in state["corrections"]])
