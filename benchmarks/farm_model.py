"""Discrete-event simulation of a batch on a farm: nodes with slots, one coordinator, one shared store, failures.

A capture is a chain of jobs, a job some stages in order. A job waits for the coordinator (which submits one job after another) and for a
free slot (first the job with most expected seconds to the end of its capture, in the classes of `gsbake.batch.jobs.start_levels`), starts,
and for each stage reads its inputs from the store, computes, and writes its output there. Transfers share the store's bandwidth equally,
each up to the share of its slot in the node's network. When a node fails, the stage in progress of each of its jobs is lost and what was
stored stays; the jobs go back into the queue once the loss was noticed. The coordinator notices the end of a job at its next look.

The clock of equal shares is that of processor-sharing queues: a virtual time that runs at the common rate, at which each transfer ends
after its own number of bytes (Kleinrock, Queueing Systems II, 1976, section 4.4).
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from gsbake.batch.jobs import LEVELS, group_stages


@dataclass(frozen=True)
class StageCost:
    """A stage on one thread: seconds of computing, and bytes read and written."""

    name: str
    seconds: float
    read_bytes: float
    written_bytes: float


@dataclass(frozen=True)
class Farm:
    """What the simulation assumes; times in seconds, rates in bytes per second.

    `start` is the time from a slot's allocation to the first stage, `submit` the coordinator's time per job, `plan` its time per capture
    before the first job, `look` the interval between its looks at the queue. Nodes fail every `node_hours` hours on average, are noticed
    after `notice` and back after `repair`; `interrupted` is the share of jobs that end with exit code 75. `spread` is the standard
    deviation of the logarithm of a capture's size, `noise` that of a stage's time, `misjudged` that of a capture's expected time over its
    true one.
    """

    nodes: int
    slots: int = 2
    store_rate: float = 1.25e9
    node_rate: float = 1.25e8
    start: float = 0.0
    submit: float = 0.0
    plan: float = 0.0
    look: float = 0.0
    node_hours: float = float("inf")
    notice: float = 300.0
    repair: float = 900.0
    interrupted: float = 0.0
    spread: float = 0.0
    noise: float = 0.0
    misjudged: float = 0.0


@dataclass(frozen=True)
class Result:
    """A finished batch: `efficiency` is the seconds of computing that count, over slots times makespan; the other shares are of the
    same."""

    makespan: float
    efficiency: float
    overhead: float
    transfer: float
    lost: float
    idle: float
    moved_bytes: float
    store_use: float
    coordinator_use: float
    jobs: int
    failures: int


@dataclass
class _Job:
    """A job: capture, number within it, remaining stages with their own seconds and bytes, where it runs, the expected seconds to the end
    of its capture, and their class."""

    capture: int
    number: int
    stages: deque[tuple[float, float, float]]
    attempt: int = 0
    node: int = -1
    phase_start: float = 0.0
    phases: deque[tuple[str, float]] = field(default_factory=deque)
    left: float = 0.0
    level: int = 0


class _Store:
    """Transfers that share a bandwidth equally."""

    def __init__(self, rate: float, each: float) -> None:
        self._rate, self._each = rate, each
        self._clock = self._virtual = 0.0
        self._ends: list[tuple[float, int, _Job, int]] = []
        self._active = 0
        self._count = 0
        self.busy = 0.0  # seconds at full bandwidth
        self.version = 0

    def advance(self, now: float) -> None:
        """Move the clock."""
        speed = self._speed()
        self._virtual += (now - self._clock) * speed
        self.busy += (now - self._clock) * speed * self._active / self._rate
        self._clock = now

    def add(self, now: float, job: _Job, size: float) -> None:
        """Begin a transfer."""
        self.advance(now)
        self._count += 1
        heapq.heappush(self._ends, (self._virtual + size, self._count, job, job.attempt))
        self._active += 1
        self.version += 1

    def drop(self, now: float) -> None:
        """A transfer was lost with its job; its entry in the heap is skipped later."""
        self.advance(now)
        self._active -= 1
        self.version += 1

    def next_end(self, now: float) -> float | None:
        """When the next transfer ends if none begins before."""
        while self._ends and self._ends[0][2].attempt != self._ends[0][3]:
            heapq.heappop(self._ends)
        return None if not self._ends else now + max(0.0, self._ends[0][0] - self._virtual) / self._speed()

    def pop(self, now: float) -> _Job:
        """The transfer that ends now."""
        self.advance(now)
        self._active -= 1
        self.version += 1
        return heapq.heappop(self._ends)[2]

    def _speed(self) -> float:
        return min(self._each, self._rate / max(self._active, 1))


def simulate(
    captures: int, kinds: Sequence[Sequence[StageCost]], farm: Farm, pack_seconds: float, seed: int = 0, *, longest_first: bool = True
) -> Result:
    """Bake captures, whose kinds alternate, with jobs of at least `pack_seconds` expected seconds."""
    return _Simulation(captures, kinds, farm, pack_seconds, seed, longest_first).run()


class _Simulation:
    def __init__(
        self, captures: int, kinds: Sequence[Sequence[StageCost]], farm: Farm, pack_seconds: float, seed: int, longest_first: bool
    ) -> None:
        self._farm, self._rng = farm, np.random.default_rng(seed)
        self._store = _Store(farm.store_rate, farm.node_rate / farm.slots)
        self._events: list[tuple[float, int, Callable[[float], None]]] = []
        self._sequence = 0
        self._chains: list[list[_Job]] = []
        self._useful = self._overhead = self._transferred = self._lost = self._moved = 0.0
        self._failures = 0
        for capture in range(captures):
            stages = kinds[capture % len(kinds)]
            size = float(np.exp(farm.spread * self._rng.standard_normal() - farm.spread**2 / 2))
            seconds = [s.seconds * size * float(np.exp(farm.noise * self._rng.standard_normal() - farm.noise**2 / 2)) for s in stages]
            believed = size * float(np.exp(farm.misjudged * self._rng.standard_normal()))
            expected = [s.seconds * believed for s in stages]
            groups = group_stages(expected, pack_seconds)
            work = [(seconds[k], stages[k].read_bytes * size, stages[k].written_bytes * size) for k in range(len(stages))]
            self._chains.append(
                [_Job(capture, n, deque(work[k] for k in group), left=sum(expected[group.start :])) for n, group in enumerate(groups)]
            )
        if longest_first:
            jobs = sorted((job for chain in self._chains for job in chain), key=lambda job: -job.left)
            for rank, job in enumerate(jobs):
                job.level = rank * LEVELS // len(jobs)
            self._chains.sort(key=lambda chain: chain[0].level)
        self._chain_of = {chain[0].capture: chain for chain in self._chains}
        self._jobs = sum(map(len, self._chains))
        self._left = captures
        self._end = 0.0
        self._queue: list[tuple[int, int, _Job]] = []
        self._queued = 0
        self._free = deque(node for _ in range(farm.slots) for node in range(farm.nodes))
        self._down = [False] * farm.nodes
        self._running: list[list[_Job]] = [[] for _ in range(farm.nodes)]
        self._coordinator_free = farm.plan * captures
        self._submitting = 0.0

    def run(self) -> Result:
        """Run to the end of the last capture."""
        farm = self._farm
        for chain in self._chains:
            self._submit(0.0, chain[0])
        if np.isfinite(farm.node_hours):
            for node in range(farm.nodes):
                self._at(self._rng.exponential(3600 * farm.node_hours), lambda now, node=node: self._fail(now, node))  # type: ignore[misc]
        while self._left:
            now, _, action = heapq.heappop(self._events)
            action(now)
        total = farm.nodes * farm.slots * self._end
        shares = [value / total for value in (self._useful, self._overhead, self._transferred, self._lost)]
        return Result(
            self._end, *shares, 1 - sum(shares), self._moved, self._store.busy / self._end, self._submitting / self._end, self._jobs,
            self._failures,
        )  # fmt: skip

    def _at(self, time: float, action: Callable[[float], None]) -> None:
        self._sequence += 1
        heapq.heappush(self._events, (time, self._sequence, action))

    def _submit(self, now: float, job: _Job) -> None:
        """The coordinator submits jobs one after another."""
        self._coordinator_free = max(self._coordinator_free, now) + self._farm.submit
        self._submitting += self._farm.submit
        self._at(self._coordinator_free, lambda time: self._enqueue(time, job))

    def _enqueue(self, now: float, job: _Job) -> None:
        self._queued += 1
        heapq.heappush(self._queue, (job.level, self._queued, job))
        self._allocate(now)

    def _allocate(self, now: float) -> None:
        while self._queue and self._free:
            node = self._free.popleft()
            if self._down[node]:
                continue  # it comes back with all its slots
            job = heapq.heappop(self._queue)[2]
            job.node = node
            self._running[node].append(job)
            job.phases = deque([("start", self._farm.start)])
            if self._rng.random() < self._farm.interrupted:
                job.phases.append(("interrupted", float(self._rng.random())))
            self._next_phase(now, job)

    def _next_phase(self, now: float, job: _Job) -> None:
        job.phase_start = now
        if not job.phases:
            if not job.stages:
                self._finish(now, job)
                return
            seconds, read, written = job.stages[0]
            job.phases = deque([("read", read), ("compute", seconds), ("write", written), ("stored", 0.0)])
        kind, amount = job.phases[0]
        attempt = job.attempt
        if kind in ("read", "write"):
            self._store.add(now, job, amount)
            self._watch_store(now)
        elif kind == "stored":
            job.phases.popleft()
            self._useful += job.stages.popleft()[0]
            self._next_phase(now, job)
        elif kind == "interrupted":  # somewhere in its first stage
            self._at(now + amount * job.stages[0][0], lambda time: self._interrupt(time, job, attempt))
        else:
            self._at(now + amount, lambda time: self._end_phase(time, job, attempt))

    def _end_phase(self, now: float, job: _Job, attempt: int) -> None:
        if job.attempt != attempt:
            return
        kind, amount = job.phases.popleft()
        if kind == "start":
            self._overhead += amount
        elif kind in ("read", "write"):
            self._transferred += now - job.phase_start
            self._moved += amount
        self._next_phase(now, job)

    def _watch_store(self, now: float) -> None:
        end, version = self._store.next_end(now), self._store.version
        if end is not None:
            self._at(end, lambda time: self._end_transfer(time, version))

    def _end_transfer(self, now: float, version: int) -> None:
        if version != self._store.version:
            return
        job = self._store.pop(now)
        self._end_phase(now, job, job.attempt)
        self._watch_store(now)

    def _release(self, now: float, job: _Job) -> None:
        self._running[job.node].remove(job)
        self._free.append(job.node)
        self._allocate(now)

    def _finish(self, now: float, job: _Job) -> None:
        chain = self._chain_of[job.capture]
        if job.number + 1 < len(chain):
            later = chain[job.number + 1]
            self._at(now + self._noticed(), lambda time: self._submit(time, later))
        else:
            self._left -= 1
            self._end = now
        self._release(now, job)

    def _noticed(self) -> float:
        """Time until the coordinator looks."""
        return float(self._rng.random()) * self._farm.look

    def _interrupt(self, now: float, job: _Job, attempt: int) -> None:
        if job.attempt != attempt:
            return
        self._lose(now, job)
        self._at(now + self._noticed(), lambda time: self._submit(time, job))
        self._release(now, job)

    def _lose(self, now: float, job: _Job) -> None:
        """The stage in progress is lost; the stages that were stored are not."""
        self._failures += 1
        job.attempt += 1
        if job.phases and job.phases[0][0] in ("read", "write"):
            self._store.drop(now)
            self._watch_store(now)
        done = job.stages[0][0] if job.phases and job.phases[0][0] == "write" and job.stages else 0.0
        self._lost += now - job.phase_start + done
        job.phases.clear()

    def _fail(self, now: float, node: int) -> None:
        """A node fails with all that runs on it."""
        farm = self._farm
        self._down[node] = True
        for job in self._running[node]:
            self._lose(now, job)
            self._at(now + farm.notice, lambda time, job=job: self._enqueue(time, job))  # type: ignore[misc]  # Slurm does that itself
        self._running[node].clear()
        self._at(now + farm.repair, lambda time: self._repair(time, node))

    def _repair(self, now: float, node: int) -> None:
        self._down[node] = False
        self._free = deque(entry for entry in self._free if entry != node)
        self._free.extend([node] * self._farm.slots)
        self._allocate(now)
        self._at(now + self._rng.exponential(3600 * self._farm.node_hours), lambda time: self._fail(time, node))
