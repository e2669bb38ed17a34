"""Time that a stage needs still, from what it is expected to take, its parts, and the steps of the present part.

Parts that have ended tell how fast this run is beside the expectation; those to come are expected to differ as much. Within a part the
steps after the first count: the first one compiles kernels and fills caches, and says nothing of those that follow. Steps differ in length,
as one with a search does, or those at full resolution; so where it is known how long a part takes, the clock counts beside the steps.

An estimate far above the time so far is a guess, and not given.
"""

from __future__ import annotations

from dataclasses import dataclass

from gsbake.text import duration
from gsbake.timing.estimate import Estimate

#: Largest multiple of the time so far that is given as time left.
MAX_RATIO = 10.0
#: Least share of a part that is left while it goes on.
LEAST_LEFT = 0.1


@dataclass(frozen=True)
class Trust:
    """How far an expectation is relied on: `weight` as a share of the stage or part that has been seen, `clock` as the share that the clock
    has in what is done of a part where its first steps are; it falls to 0 at the last one."""

    weight: float
    clock: float


#: After runs with the same settings, after runs with others, and after none.
SAME, OTHER, FORMULA = Trust(0.15, 0.5), Trust(0.1, 0.25), Trust(0.05, 0.0)


class TimeLeft:
    """Estimate for one running stage; times are seconds of any clock, which started at `now`."""

    def __init__(self, now: float, expected: Estimate | None = None) -> None:
        self._start = now
        self._total = expected.seconds if expected is not None else 0.0
        self._trust = FORMULA if expected is None or not expected.measured else SAME if expected.same else OTHER
        parts = {name: share * self._total for name, share in expected.parts.items()} if expected is not None else {}
        self._parts = parts | {"": max(self._total - sum(parts.values()), 0.0)}  # the last one: what is in no part
        self._ended: dict[str, float] = {}
        self._unexpected = 0.0  # in parts that nobody expected, since the last one that was
        self._part, self._part_start = "", now
        self._share, self._first, self._repeats = 0.0, (now, 0.0), False

    def start_part(self, now: float, name: str) -> None:
        """A part starts, and the one before has ended."""
        self._ended[self._part] = self._ended.get(self._part, 0.0) + now - self._part_start
        expected = self._part in self._parts or name in self._parts
        self._unexpected = 0.0 if expected else self._unexpected + now - self._part_start
        self._part, self._part_start = name, now
        self._share, self._first, self._repeats = 0.0, (now, 0.0), False

    def update(self, now: float, done: int, total: int) -> None:
        """Steps of the present part are done. Where they start over, nobody knows how often they will: from then on the clock counts."""
        share = done / total if total > 0 else 0.0
        self._repeats = self._repeats or share < self._share
        if done > 0 and self._share == 0:
            self._first = (now, share)
        self._share = share

    def seconds(self, now: float) -> float | None:
        """Seconds left of the stage; None where they are not known."""
        known = {name: seconds for name, seconds in self._ended.items() if self._parts.get(name)}
        weight, expected = self._trust.weight * self._total, sum(self._parts[name] for name in known)
        pace = (weight + sum(known.values())) / (weight + expected) if weight + expected > 0 else 1.0
        order = list(self._parts)
        reached = max((order.index(name) for name in (*known, self._part) if name in order[:-1]), default=-1)
        to_come = [self._parts[name] for name in order[reached + 1 : -1]]  # what was passed over is left out
        unexpected = self._unexpected + (0.0 if self._part in self._parts else now - self._part_start)
        if to_come:  # what is unexpected stands for the next part
            to_come[0] -= min(unexpected / pace, (1 - LEAST_LEFT) * to_come[0])
        seen = expected / self._total if self._total > 0 else 0.0  # ended parts tell what to expect of the present one
        trust = Trust(max(self._trust.weight, 0.5 * seen), max(self._trust.clock, seen))
        left = pace * sum(to_come) + self._left_in_part(now, pace * self._parts.get(self._part, 0.0), trust)
        return left if 0 < left <= MAX_RATIO * (now - self._start) else None

    def text(self, now: float) -> str:
        """The time left in words."""
        left = self.seconds(now)
        return "time left unknown" if left is None else f"about {duration(left)} left"

    def _left_in_part(self, now: float, expected: float, trust: Trust) -> float:
        """Seconds left of the present part, which is `expected` to take so many in all."""
        start, first = self._first
        done, spent = self._share - first, now - start
        known = done > 0 and self._share < 1 and not self._repeats
        if expected == 0:
            return spent / done * (1 - self._share) if known else 0.0
        if not known:
            taken = now - self._part_start
            return max(expected - taken, LEAST_LEFT * max(expected, taken))
        weight, clock, taken = trust.weight, trust.clock * (1 - self._share), spent / expected
        by_clock = min(taken * (weight + done) / (weight + taken), 1 - LEAST_LEFT)
        done = (1 - clock) * done + clock * by_clock
        return max(1 - first - done, 0.0) * expected * (weight + taken) / (weight + done)
