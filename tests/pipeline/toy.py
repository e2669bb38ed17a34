"""Toy stages for tests of the engine: read words, sum over steps, write the total."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from gsbake.errors import BadInputError, GsbakeError
from gsbake.pipeline.engine import Engine, Observer
from gsbake.pipeline.plan import Request
from gsbake.pipeline.registry import Registry
from gsbake.pipeline.stage import Context, Stage
from gsbake.pipeline.store import MANIFEST


class Read(BaseModel):
    limit: int = 100


class Sum(BaseModel):
    steps: int = 10
    step_seconds: float = 0.0
    ignored: str = "x"


class Toy(BaseModel):
    """Profile of the toy pipeline."""

    read: Read = Read()
    sum: Sum = Sum()


class LaterSum(Sum):
    extra: int = 7


class LaterToy(BaseModel):
    """The toy profile with one more field."""

    read: Read = Read()
    sum: LaterSum = LaterSum()


def _read(ctx: Context) -> dict[str, Any]:
    words = sorted(word.lower() for path in sorted(ctx.inputs["photos"].iterdir()) for word in path.read_text().split())
    words = words[: ctx.settings.read.limit]
    (ctx.out / "words.txt").write_text("\n".join(words))
    ctx.decide("case", "lower", "it is a toy")
    return {"words": len(words)}


def _sum(ctx: Context) -> dict[str, Any]:
    """Sum over steps, with a checkpoint after each."""
    state = {"step": 0, "total": ctx.seed}
    saved = ctx.checkpoint / "state.json"
    if saved.exists():
        state = json.loads(saved.read_text())
    words = len((ctx.inputs["read"] / "words.txt").read_text().split())
    steps = ctx.settings.sum.steps
    with ctx.part("loop"):
        while state["step"] < steps:
            time.sleep(ctx.settings.sum.step_seconds)
            state = {"step": state["step"] + 1, "total": (state["total"] * 31 + words + state["step"]) % 1_000_003}
            temporary = saved.with_suffix(".tmp")
            temporary.write_text(json.dumps(state))
            temporary.replace(saved)
            ctx.progress(state["step"], steps, psnr=float(state["step"]))
            if ctx.stop_requested():
                ctx.check_stop()
    ctx.decide("rest", "skipped", "not needed", 12.345)
    (ctx.out / "total.txt").write_text(str(state["total"]))
    return {"total": state["total"]}


def _tell(ctx: Context) -> dict[str, Any]:
    (ctx.out / "tell.txt").write_text("total " + (ctx.inputs["sum"] / "total.txt").read_text())
    return {}


def _undeclared(ctx: Context) -> dict[str, Any]:
    return {"value": ctx.settings.sum.ignored}


def _stubborn(ctx: Context) -> dict[str, Any]:
    """Ignores SIGTERM and does not poll for stop requests."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    (ctx.out / "half.txt").write_text("half")
    ctx.progress(0, 1)
    time.sleep(60)
    return {}


def _crash(ctx: Context) -> dict[str, Any]:
    os.write(2, b"about to crash\n")
    os.kill(os.getpid(), signal.SIGABRT)
    return {}


def _terminated(ctx: Context) -> dict[str, Any]:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # as in a worker that has just started
    os.kill(os.getpid(), signal.SIGTERM)
    return {}


def _raise(ctx: Context) -> dict[str, Any]:
    kind = (ctx.inputs["photos"] / "kind.txt").read_text()
    if kind == "bad":
        raise BadInputError("The toy is broken; buy another.")
    if kind == "memory":
        raise MemoryError("no room")
    if kind == "full":
        raise OSError(28, "No space left on device", str(ctx.out / "x"))
    raise ValueError("unexpected value")


READ = Stage("read", 1, "Read words", _read, sources=("photos",), settings=("read.*",))
SUM = Stage("sum", 1, "Sum slowly", _sum, needs=("read",), settings=("sum.steps", "sum.step_seconds"), seeded=True)
TELL = Stage("tell", 1, "Tell", _tell, needs=("sum",))
UNDECLARED = Stage("undeclared", 1, "Peek", _undeclared, settings=("sum.steps",))
STUBBORN = Stage("stubborn", 1, "Stubborn", _stubborn)
CRASH = Stage("crash", 1, "Crash", _crash)
TERMINATED = Stage("terminated", 1, "Terminated", _terminated)
RAISE = Stage("raise", 1, "Raise", _raise, sources=("photos",))

CHAIN = Registry({name: f"tests.pipeline.toy:{name.upper()}" for name in ("read", "sum", "tell")})


def only(name: str) -> Registry:
    """A registry of one toy stage."""
    return Registry({name: f"tests.pipeline.toy:{name.upper()}"})


class Recorder(Observer):
    """Observer that records its events."""

    def __init__(self) -> None:
        self.ran: list[str] = []
        self.cached: list[str] = []
        self.waited: list[str] = []
        self.reports: list[tuple[int, int, dict[str, float]]] = []
        self.parts: list[tuple[str, str]] = []

    def part_started(self, name: str, part: str) -> None:
        self.parts.append((name, part))

    def stage_reused(self, state: Any) -> None:
        self.cached.append(state.name)

    def stage_finished(self, state: Any) -> None:
        self.ran.append(state.name)

    def stage_waiting(self, name: str, holder: Any) -> None:
        self.waited.append(str(holder))

    def progress(self, name: str, done: int, total: int, text: str, live: Mapping[str, float]) -> None:
        self.reports.append((done, total, dict(live)))


def artifact(out: Path, stage: str) -> Path:
    """Folder of an artifact of a stage."""
    return next(path.parent for path in (out / "stages" / stage).glob(f"*/{MANIFEST}"))


def engine(out: Path, photos: Path, profile: BaseModel | None = None, registry: Registry = CHAIN, seed: int = 0) -> tuple[Engine, Recorder]:
    """An engine of toy stages, and the recorder that observes it."""
    recorder = Recorder()
    return Engine(registry, Request(out, {"photos": photos}, profile or Toy(), seed=seed), recorder), recorder


def main() -> None:
    """Run `OUT PHOTOS STAGES [STEPS SECONDS]` in its own process, for tests that kill it."""
    out, photos, stages = sys.argv[1:4]
    numbers = {"steps": int(sys.argv[4]), "step_seconds": float(sys.argv[5])} if len(sys.argv) > 4 else {}
    registry = CHAIN if stages == "chain" else only(stages)
    made, recorder = engine(Path(out), Path(photos), Toy(sum=Sum(**numbers)), registry)
    try:
        made.run()
    except GsbakeError as error:
        sys.stderr.write(str(error))
        raise SystemExit(error.exit_code) from None
    sys.stdout.write(json.dumps({"ran": recorder.ran, "cached": recorder.cached, "waited": recorder.waited[:1]}))
