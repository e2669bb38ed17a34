"""Time that a stage needs still, from how fast it has been lately.

The first step of a part is left out: it compiles kernels and fills caches, and says nothing of those that follow (one that took a minute
made a minute's training look like hours). A part is a run of reports with one total and text; its rate is that of its last seconds.
No estimate is given before there is enough to go by.
"""

from __future__ import annotations

from collections import deque

#: Seconds of the past that the rate is taken from.
WINDOW = 30.0
#: Seconds after the first step, and steps, from which on an estimate is given.
MIN_SECONDS, MIN_STEPS = 2.0, 2


class TimeLeft:
    """Estimate for the running part of one stage; times are seconds of any clock."""

    def __init__(self) -> None:
        self._part: tuple[int, str] | None = None
        self._reports: deque[tuple[float, int]] = deque()

    def update(self, now: float, done: int, total: int, text: str = "") -> float | None:
        """Add a report; seconds left in this part, or None where that is not known yet."""
        part = (total, text.partition(":")[0])
        if part != self._part or (self._reports and done < self._reports[-1][1]):
            self._part = part
            self._reports.clear()
            if done == 0:
                return None
        # Reports at 0 are before the first step, which is left out: the clock starts when it is done.
        if done > 0 and (not self._reports or done > self._reports[-1][1]):
            self._reports.append((now, done))
        while len(self._reports) > MIN_STEPS + 1 and now - self._reports[1][0] > WINDOW:
            self._reports.popleft()
        if not self._reports:
            return None
        start, first = self._reports[0]
        steps = self._reports[-1][1] - first
        if done >= total:
            return 0.0
        # Time since the last report counts, so that a step that hangs is seen.
        seconds = now - start
        if steps < MIN_STEPS or seconds < MIN_SECONDS:
            return None
        return seconds / steps * (total - done)
