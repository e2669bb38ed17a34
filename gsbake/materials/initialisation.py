"""Which roughness the fit of materials starts from, and whether it looks for metals: settled by photos that took no part.

How rough the object is at the start decides which light is found: a surface taken for rough cannot show where the light comes from and its
reflections end as paint; one taken for smooth blurs the light instead. So short trials from a few values compete on photos they were not
fitted to, and the best goes on. Where two are close, both are fitted in full.

Metals that a fit found should show in other photos, too. Where those are shown nearly as well without any metallic, the metals may be white
or black paint that passes for metal, and the fit is made again without looking for any.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from gsbake.materials.fit import FitSchedule, Fitted, MaterialFit
from gsbake.materials.map_selection import without_metal
from gsbake.materials.pixels import Pixels

#: Roughness of all texels that trials start from, and their steps, pixels of a photo and every how many-th photo judges them.
TRIALS, TRIAL_STEPS, TRIAL_PIXELS, TRIAL_PHOTO = (0.2, 0.45, 0.8), 100, 15_000, 5
#: Starts that a trial leaves less than this behind the best (dB) are fitted in full as well: 100 steps find a blurred light sooner than a
#: sharp one, and so favour smooth starts.
RIVAL = 1.0
#: Metals that held-out photos miss by less than this (dB) are doubted.
DOUBTED = 0.5

#: Builds a fit that starts from a roughness.
Make = Callable[[float], MaterialFit]


@dataclass(frozen=True)
class Choice:
    """The `fit` chosen and what it `fitted`, the `roughness` it started from, how many fits were made in full, and the evidence for the
    start and, where metals were doubted, against or for them."""

    fit: MaterialFit
    fitted: Fitted
    roughness: float
    fits: int
    why: str
    metals: str | None


def best_fit(
    make: Make,
    photos: list[Pixels],
    held: list[Pixels],
    steps: int,
    seed: int,
    trials: Mapping[float, float],
    matte: bool,
    each: Callable[[int, int], None] | None = None,
) -> Choice:
    """Fit in full from every start that the `trials` (PSNR in dB of each) leave open, and keep what shows the `held` photos best.

    Things that are `matte` start from the roughest and have no metals. Without held photos the first start is taken.
    """
    judged = any(map(len, held))
    starts = rivals(trials) or [TRIALS[-1] if matte else TRIALS[1]]
    starts = starts if judged else starts[:1]
    fits = [make(roughness) for roughness in starts]
    results = [fit.run(photos, held, FitSchedule(steps, seed, diffuse=matte), each) for fit in fits]
    best = max(range(len(fits)), key=lambda k: results[k].held_out or 0.0)
    chosen, fitted, made = fits[best], results[best], len(fits)
    why = ", ".join(f"{score:.2f} dB from {roughness:g}" for roughness, score in trials.items())
    if len(fits) > 1:
        why += "; fitted in full " + ", ".join(f"{f.held_out:.2f} dB from {r:g}" for f, r in zip(results, starts, strict=True))
    evidence = None
    bare = chosen.psnr(held, without_metal(fitted.values)) if fitted.metal.any() else None
    if bare is not None and fitted.held_out is not None and bare > fitted.held_out - DOUBTED:
        again = make(starts[best])
        other = again.run(photos, held, FitSchedule(steps, seed, metallic=False), each)
        made += 1
        evidence = f"held-out photos are shown to {fitted.held_out:.2f} dB with them, fitted without to {other.held_out or 0.0:.2f} dB"
        if (other.held_out or 0.0) > fitted.held_out:
            chosen, fitted = again, other
    return Choice(chosen, fitted, starts[best], made, why or ("the object is matt" if matte else "too few photos for trials"), evidence)


def trial_roughness(
    make: Make, photos: list[Pixels], seed: int, each: Callable[[int, int], None] | None = None
) -> dict[float, float]:
    """PSNR in dB on photos set aside, for each roughness in `TRIALS` as the start of a short fit.

    Empty with fewer than `TRIAL_PHOTO` photos.
    """
    if len(photos) < TRIAL_PHOTO:
        return {}
    few = [p.thinned(TRIAL_PIXELS) for p in photos]
    judges, rest = few[::TRIAL_PHOTO], [p for i, p in enumerate(few) if i % TRIAL_PHOTO]
    found: dict[float, float] = {}
    for turn, roughness in enumerate(TRIALS):
        schedule = FitSchedule(TRIAL_STEPS, seed, metallic=False, emission=False, intensity=False, sparsity=False)
        score = make(roughness).run(rest, judges, schedule).held_out
        if score is not None:
            found[roughness] = score
        if each is not None:
            each(turn + 1, len(TRIALS))
    return found


def rivals(trials: Mapping[float, float]) -> list[float]:
    """The roughnesses of `trials` (PSNR in dB of each) that a whole fit must tell apart, best first."""
    order = sorted(trials, key=lambda roughness: -trials[roughness])
    return [roughness for roughness in order if trials[roughness] > trials[order[0]] - RIVAL]


def trial_cost(photos: list[Pixels], step: float) -> float:
    """Seconds that `trial_roughness` would take, from those of one `step` of the fit itself: steps cost by the pixels they shade."""
    if len(photos) < TRIAL_PHOTO:
        return 0.0
    pixels = sum(len(p) for p in photos) / len(photos)
    return len(TRIALS) * TRIAL_STEPS * step * min(1.0, TRIAL_PIXELS / max(1.0, pixels))
