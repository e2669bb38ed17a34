"""Whether training has converged: held-out PSNR and the surfels' median distance from their surface stand still."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

#: Rows of the training log that are compared: the last one with those before it.
ROWS = 4
#: Gain of held-out PSNR (dB) and relative change of the SDF median over these rows that count as standing still.
STILL_DB, STILL_SDF = 0.05, 0.02


def stands_still(log: Sequence[Mapping[str, float]]) -> tuple[bool, str]:
    """Whether the last rows of a training log (`step`, `psnr` in dB, `sdf_median` in the unit frame) stand still, and the evidence."""
    last = log[-ROWS:]
    if len(last) < ROWS:
        return False, f"{len(last)} evaluations, {ROWS} are compared"
    gain = last[-1]["psnr"] - max(row["psnr"] for row in last[:-1])
    drift = abs(last[-1]["sdf_median"] - last[0]["sdf_median"]) / max(last[0]["sdf_median"], 1e-9)
    evidence = (
        f"from step {last[0]['step']:.0f} to {last[-1]['step']:.0f} held-out PSNR gained {gain:+.2f} dB "
        f"and the SDF median changed by {100 * drift:.0f} %"
    )
    return gain < STILL_DB and drift < STILL_SDF, evidence
