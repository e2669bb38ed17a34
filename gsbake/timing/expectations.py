"""What the stages of a run are expected to take, from earlier runs in its output folder and in those beside it."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from gsbake.pipeline.plan import Request, StageState
from gsbake.timing.estimate import Estimate, History
from gsbake.timing.photos import photos_of_request, photos_of_run

#: Runs that are read, the latest ones.
MAX_RUNS = 16


class Expectations:
    """Estimates for the stages of one run; earlier runs are read when the first of these starts."""

    def __init__(self, request: Request, stages: tuple[str, ...]) -> None:
        self._request, self._stages = request, stages
        self._history: History | None = None

    def of(self, state: StageState) -> Estimate:
        """The estimate of a stage that starts."""
        if self._history is None:
            self._history = History.of_runs(runs_beside(self._request.out), self._stages)
        photos = photos_of_run(self._request.out) or photos_of_request(self._request)
        return self._history.estimate(state.name, photos, state.settings, self._request.threads)


def runs_beside(out: Path) -> list[Path]:
    """The output folders in the folder that holds `out`, itself included: the latest ones, at most MAX_RUNS."""
    dated = []
    for project in out.absolute().parent.glob("*/project.json"):
        with suppress(OSError):  # deleted meanwhile
            dated.append((project.stat().st_mtime, project.parent))
    return [folder for _, folder in sorted(dated, reverse=True)[:MAX_RUNS]]
