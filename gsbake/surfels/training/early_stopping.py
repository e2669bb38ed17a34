"""Plateau detection for early stopping, on held-out PSNR and the median SDF sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

#: Rows of the training log that are compared: the last one with the others.
WINDOW = 4
#: A plateau: the gain of held-out PSNR (dB) and the relative change of the SDF median over these rows stay below.
MAX_PSNR_GAIN, MAX_SDF_CHANGE = 0.05, 0.02


def has_plateaued(log: Sequence[Mapping[str, float]]) -> tuple[bool, str]:
    """Whether the last rows of a training log (`step`, `psnr` in dB, `sdf_median` in the unit frame) are a plateau, and the evidence."""
    last = log[-WINDOW:]
    if len(last) < WINDOW:
        return False, f"{len(last)} evaluations; {WINDOW} are needed"
    gain = last[-1]["psnr"] - max(row["psnr"] for row in last[:-1])
    drift = abs(last[-1]["sdf_median"] - last[0]["sdf_median"]) / max(last[0]["sdf_median"], 1e-9)
    evidence = (
        f"from step {last[0]['step']:.0f} to {last[-1]['step']:.0f} held-out PSNR gained {gain:+.2f} dB "
        f"and the SDF median changed by {100 * drift:.0f} %"
    )
    return gain < MAX_PSNR_GAIN and drift < MAX_SDF_CHANGE, evidence
