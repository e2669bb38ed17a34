"""Fits at the same time: results in order, steps of all together, and errors of one that stop the others."""

from __future__ import annotations

import threading
from functools import partial

import numba
import numpy as np
import pytest

from gsbake.errors import InterruptedRun
from gsbake.materials import concurrent_fits
from gsbake.materials.concurrent_fits import Each, run_concurrently


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """One thread and two, whatever the machine and the threading layer."""
    monkeypatch.setattr(numba, "get_num_threads", lambda: request.param)
    monkeypatch.setattr(numba, "set_num_threads", lambda count: None)
    monkeypatch.setattr(concurrent_fits, "_thread_safe", lambda: True)
    return int(request.param)


def fit(value: int, steps: int, each: Each) -> int:
    """A fit of so many steps that finds its value."""
    for step in range(steps):
        each(step + 1, steps)
    return value


def test_results_are_in_order_and_steps_are_counted_together(threads: int) -> None:
    seen: list[tuple[int, int]] = []
    found = run_concurrently([partial(fit, value, 5) for value in range(4)], lambda done, total: seen.append((done, total)))
    assert found == [0, 1, 2, 3]
    assert [done for done, _ in seen] == [*range(1, 21)]
    assert {total for _, total in seen} == {20}


def test_two_fits_run_at_the_same_time(threads: int) -> None:
    """Each waits for the other one, which with one thread never comes."""
    barrier = threading.Barrier(2)

    def meet(each: Each) -> bool:
        try:
            barrier.wait(5 if threads == 2 else 0.05)
        except threading.BrokenBarrierError:
            return False
        return True

    assert run_concurrently([meet, meet], lambda done, total: None) == [threads == 2] * 2


def test_a_stop_request_ends_all(threads: int) -> None:
    def stop(done: int, total: int) -> None:
        if done == 7:
            raise InterruptedRun("Stopped on request.")

    with pytest.raises(InterruptedRun):
        run_concurrently([partial(fit, value, 1_000_000) for value in range(3)], stop)


def test_an_error_of_one_stops_the_others_and_is_raised(threads: int) -> None:
    done = np.zeros(2, int)

    def fails(each: Each) -> int:
        raise ValueError("singular")

    def long(each: Each) -> int:
        for _ in range(10_000_000):
            each(1, 10_000_000)
            done[1] += 1
        return 1

    with pytest.raises(ValueError, match="singular"):
        run_concurrently([fails, long] if threads == 1 else [long, fails], lambda done, total: None)
    assert done[1] < 10_000_000


@pytest.mark.parametrize(("layer", "safe"), [("omp", True), ("tbb", True), ("workqueue", False), (None, False)])
def test_unsafe_threading_layers_run_one_fit_at_a_time(layer: str | None, safe: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    def threading_layer() -> str:
        if layer is None:
            raise ValueError("Threading layer is not initialized.")
        return layer

    monkeypatch.setattr(numba, "threading_layer", threading_layer)
    assert concurrent_fits._thread_safe() == safe
