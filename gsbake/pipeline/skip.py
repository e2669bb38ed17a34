"""Work left out because a scene does not need it: the evidence decides unless the profile does, and the manifest says what was decided.

A rule is a function of the library that takes measurements and returns whether the work can be left out, with a sentence of evidence. A
stage hands both to `leave_out`. The decision is logged under the name of the setting ("skip.photos") that turns the rule on and off.
"""

from __future__ import annotations

from gsbake.pipeline.stage import Context

#: Decisions about left-out work start with this; the rest is the rule's name.
PREFIX = "skip."


def wanted(ctx: Context, rule: str, holds: bool) -> bool:
    """Whether the work of `rule` is to be left out: as the evidence says (`holds`), unless the profile says always or never."""
    mode = getattr(ctx.settings.skip, rule)
    return holds if mode == "auto" else mode == "always"


def leave_out(ctx: Context, rule: str, holds: bool, evidence: str, skipped: str, done: str, saved: float | None = None) -> bool:
    """Decide on `rule` and log it; returns whether the work is left out.

    `holds` and `evidence` are the rule's verdict; `skipped` and `done` say in words what either choice means here. `saved` is the time
    in seconds that leaving the work out saves, where it was measured or follows from what was; None where nobody knows.
    """
    out = wanted(ctx, rule, holds)
    if getattr(ctx.settings.skip, rule) != "auto":
        evidence += "; the profile asks for it"
    ctx.decide(PREFIX + rule, skipped if out else done, evidence, saved if out else None)
    return out
