"""Poses and exposures corrected while surfels train: first asked whether that is worth a trial, then tried, and kept if photos gain.

Held-out photos shaped no surfel. Fitted to the surfels on half of their pixels (squares of a checkerboard), they tell two things on the
other half: how far photos are off, and how well surfels fit them however they are posed. The first asks for a trial: the same steps with
and without corrected photos, of which the better by the second is kept. The corrections alternate with training (block coordinate
descent); `align` makes each of them with the surfels frozen.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsbake.surfels.training import alignment as align
from gsbake.surfels.training.corrections import Correction, without_common
from gsbake.surfels.training.trainer import Trainer

#: Share of the run after which photos are looked at, and after which they are corrected anew; but each is trained on in between.
FROM, EVERY = 0.3, 0.05
#: Steps of a trial, as a share of the run; at least one per photo. Surfels take that long to gain from better poses (docs/poses.md).
TRIAL = 0.3
#: A trial is worth its time where photos are off by so many pixels and this share of their longer side (median over held-out photos):
#: against exact poses, surfels that are not done yet are off by .2 to .9 pixels of 400.
LEAST_MOVE, LEAST_SHARE = 1.5, 1.5 / 400
#: The same for exposures: root mean square of the log gains.
LEAST_GAIN = 0.08
#: Held-out PSNR (dB) that corrections must gain in the mean, and the share of the photos that must gain.
LEAST_DB, LEAST_WINNING = 0.1, 0.6
#: Photos that are looked at, at most, and the edge of the checkerboard's squares in pixels.
MOST_LOOKED_AT, SQUARE = 8, 16
#: Blurs of `align` where photos have been corrected before.
LAST_BLUR = (1.0,)


@dataclass(frozen=True)
class Corrected:
    """Which corrections are made."""

    poses: bool
    gains: bool

    def __bool__(self) -> bool:
        return self.poses or self.gains


@dataclass(frozen=True)
class Look:
    """How photos (k) fit once they may move: PSNR (k,) in dB on pixels that no fit saw, motion (k,) in pixels, and log gains (k, 3)."""

    psnr: Tensor
    move: Tensor
    gain: Tensor


def worth_trying(look: Look, size: int) -> tuple[Corrected, str]:
    """Which corrections deserve a trial, and the evidence in words; `size` is the photos' longer side in pixels."""
    move, least = float(look.move.median()), max(LEAST_MOVE, LEAST_SHARE * size)
    gain = float((look.gain - look.gain.mean(0)).square().mean().sqrt())
    words = f"photos are off by {move:.1f} px and {100 * gain:.0f} % of exposure; {least:.2g} px and {100 * LEAST_GAIN:g} % deserve a trial"
    return Corrected(move >= least, gain >= LEAST_GAIN), words


def gained(before: Tensor, after: Tensor) -> tuple[bool, str]:
    """Whether held-out photos (k) fit better after a trial, PSNR in dB before and after, and the evidence in words."""
    gain = after - before
    holds = float(gain.mean()) >= LEAST_DB and float((gain > 0).double().mean()) >= LEAST_WINNING
    return holds, f"a trial gained {float(gain.mean()):+.2f} dB on held-out photos; {LEAST_DB:g} dB are needed"


class Aligner:
    """The corrections of a trainer's photos."""

    def __init__(self, trainer: Trainer, poses: str, gains: str) -> None:
        """`poses` and `gains` are the rules of the profile: "always" leaves these corrections out, "never" makes them, "auto" tries."""
        self.trainer, self.modes = trainer, Corrected(poses == "never", gains == "never")
        self.allowed = Corrected(poses != "always", gains != "always")
        self.given = list(trainer.views), list(trainer.half)
        self.corrections = [Correction.none() for _ in trainer.views]
        self.on = None if "auto" in (poses, gains) else self.modes
        self.evidence = "not looked at"
        self.corrected_at = -1

    def visit(self, stopped: Callable[[], bool]) -> None:
        """Decide and correct if the run has come that far; a trial is given up, to be made again, when `stopped` says so."""
        done, n, end = self.trainer.done, self.trainer.plan.iterations, self.trainer.end
        if done < FROM * n or done == self.corrected_at:
            return
        if self.on is None:
            self._decide(stopped)
        elif self.on and (self.corrected_at < 0 or done == end or done - self.corrected_at >= max(len(self.trainer.used), EVERY * n)):
            self.correct(self.on)

    @property
    def outcome(self) -> Corrected:
        """What is corrected; nothing as long as that is undecided."""
        return self.on or Corrected(False, False)

    # -- deciding -----------------------------------------------------------------------------------------------------------------

    def _scene(self) -> align.Scene:
        t = self.trainer
        return align.scene_of(t.surfels, t.light, t.masked, t.background)

    def look(self, what: Corrected) -> Look:
        """Fit held-out photos (training photos where none is held out) on half of their pixels and compare the other half."""
        t = self.trainer
        pool = t.held or t.used
        scene, rows = self._scene(), []
        for i in pool[:: -(-len(pool) // MOST_LOOKED_AT)]:
            view = t.views[i]
            h, w = view.rgb.shape[1:]
            y, x = torch.arange(h, device=view.rgb.device) // SQUARE, torch.arange(w, device=view.rgb.device) // SQUARE
            even = (y[:, None] + x) % 2 == 0
            fit = align.align(scene, view, Correction.none(), what.poses, what.gains, even)
            rows.append((align.psnr(scene, view, fit, ~even), align.motion(scene, view, fit), fit.gain))
        return Look(torch.tensor([r[0] for r in rows]), torch.tensor([r[1] for r in rows]), torch.stack([r[2] for r in rows]))

    def _decide(self, stopped: Callable[[], bool]) -> None:
        size = max(self.trainer.views[0].rgb.shape[1:])
        promising, self.evidence = worth_trying(self.look(Corrected(True, True)), size)
        poses = self.modes.poses or (self.allowed.poses and promising.poses)
        what = Corrected(poses, self.modes.gains or (self.allowed.gains and promising.gains))
        if what == self.modes:
            self.on = what
            return
        trainer, steps = self.trainer, max(len(self.trainer.used), round(TRIAL * self.trainer.plan.iterations))
        begun = copy.deepcopy(trainer.state())
        self.correct(what)
        with_it = self._train(steps, stopped)
        after, corrections = self.look(what), self.corrections
        self._restore(begun, [Correction.none() for _ in corrections])
        if with_it is None:
            return
        without = self._train(steps, stopped)
        before = self.look(what)
        if without is None:
            self._restore(begun, self.corrections)
            return
        holds, words = gained(before.psnr, after.psnr)
        self.evidence = f"{self.evidence}: {words}"
        self.on = what if holds else self.modes
        if holds:
            self._restore(with_it, corrections)
        self.corrected_at = trainer.done

    def _train(self, steps: int, stopped: Callable[[], bool]) -> dict[str, Any] | None:
        """Train on for some steps; the state after them, or None when stopped."""
        for _ in range(min(steps, self.trainer.end - self.trainer.done)):
            if stopped():
                return None
            self.trainer.step()
        return copy.deepcopy(self.trainer.state())

    # -- correcting ---------------------------------------------------------------------------------------------------------------

    def correct(self, what: Corrected) -> None:
        """Fit all photos to the surfels as they are, from the corrections found so far on."""
        scene, blurs = self._scene(), align.BLURS if self.corrected_at < 0 else LAST_BLUR
        views = self.given[0]
        found = [align.align(scene, v, c, what.poses, what.gains, None, blurs) for v, c in zip(views, self.corrections, strict=True)]
        self._apply(without_common(views, found))
        self.corrected_at = self.trainer.done

    def _apply(self, corrections: list[Correction]) -> None:
        self.corrections = corrections
        for views, given in zip((self.trainer.views, self.trainer.half), self.given, strict=True):
            views[:] = [c.of(v) for v, c in zip(given, corrections, strict=True)]

    # -- checkpoints --------------------------------------------------------------------------------------------------------------

    def _restore(self, state: dict[str, Any], corrections: list[Correction]) -> None:
        self.trainer.restore(copy.deepcopy(state))
        self._apply(corrections)
        self.corrected_at = -1

    def state(self) -> dict[str, Any]:
        """Everything that decides how the corrections go on."""
        on = None if self.on is None else (self.on.poses, self.on.gains)
        table = torch.stack([torch.cat([c.twist, c.gain]) for c in self.corrections])
        return {"on": on, "corrections": table, "evidence": self.evidence, "corrected_at": self.corrected_at}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what `state` returned."""
        self.on = None if state["on"] is None else Corrected(*state["on"])
        self.evidence, self.corrected_at = state["evidence"], state["corrected_at"]
        self._apply([Correction(row[:6].clone(), row[6:].clone()) for row in state["corrections"]])
