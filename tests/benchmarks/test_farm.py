"""The simulation of a farm against cases whose result is known."""

from __future__ import annotations

import json
from dataclasses import asdict
from statistics import mean

import pytest

from benchmarks.farm import farm, run, table
from benchmarks.farm_costs import Costs, Kind, bytes_read, read_costs
from benchmarks.farm_model import Farm, StageCost, simulate
from gsbake.batch.jobs import group_stages
from gsbake.stages import REGISTRY

CHAIN = [StageCost("a", 30.0, 0.0, 0.0), StageCost("b", 70.0, 0.0, 0.0)]


@pytest.mark.parametrize("pack", [0.0, 50.0, float("inf")])
def test_full_slots_have_no_idle_time(pack: float) -> None:
    found = simulate(8, [CHAIN], Farm(nodes=2, slots=2), pack)
    assert found.makespan == pytest.approx(200.0) and found.efficiency == pytest.approx(1.0)
    assert found.jobs == (16 if not pack else 8)


def test_starts_and_submissions_cost_what_they_cost() -> None:
    found = simulate(4, [CHAIN], Farm(nodes=1, slots=1, start=5.0), 0.0)
    assert found.makespan == pytest.approx(4 * (100 + 2 * 5)) and found.overhead == pytest.approx(40 / 440)
    found = simulate(4, [CHAIN], Farm(nodes=4, slots=1, submit=10.0, plan=2.0), float("inf"))
    assert found.makespan == pytest.approx(4 * 2 + 4 * 10 + 100)  # the last capture begins when it is submitted


def test_transfers_share_the_store_and_are_limited_by_the_node() -> None:
    alone = [StageCost("a", 0.0, 1e9, 0.0)]
    assert simulate(1, [alone], Farm(nodes=1, slots=1, store_rate=1e8, node_rate=1e9), 0.0).makespan == pytest.approx(10.0)
    assert simulate(1, [alone], Farm(nodes=1, slots=1, store_rate=1e9, node_rate=1e8), 0.0).makespan == pytest.approx(10.0)
    four = simulate(4, [alone], Farm(nodes=4, slots=1, store_rate=1e8, node_rate=1e9), 0.0)
    assert four.makespan == pytest.approx(40.0) and four.store_use == pytest.approx(1.0) and four.moved_bytes == pytest.approx(4e9)
    # 1 and 3 GB together at 0.1 GB/s: 20 s shared, then 2 GB alone
    kinds = [[StageCost("a", 0.0, 1e9, 0.0)], [StageCost("a", 0.0, 3e9, 0.0)]]
    assert simulate(2, kinds, Farm(nodes=2, slots=1, store_rate=1e8, node_rate=1e9), 0.0).makespan == pytest.approx(40.0)


def test_failures_lose_the_stage_in_progress_only() -> None:
    quiet = simulate(200, [CHAIN], Farm(nodes=10, spread=0.2, noise=0.1), 0.0, seed=1)
    rough = Farm(nodes=10, spread=0.2, noise=0.1, node_hours=0.5, notice=30.0, repair=60.0, interrupted=0.05)
    found = simulate(200, [CHAIN], rough, 0.0, seed=1)
    assert found.failures > 20 and found.makespan > quiet.makespan and 0.02 < found.lost < 0.3
    busy = found.efficiency + found.overhead + found.transfer + found.lost + found.idle
    assert busy == pytest.approx(1.0) and found.idle > 0
    assert found.efficiency * found.makespan == pytest.approx(quiet.efficiency * quiet.makespan, rel=0.05)  # the same work counts


def test_the_sum_of_slots_is_conserved_under_everything_at_once() -> None:
    chain = [StageCost("a", 20.0, 5e7, 2e8), StageCost("b", 60.0, 2e8, 1e7)]
    hard = Farm(5, start=3.0, submit=0.5, look=10.0, store_rate=2e8, node_hours=1.0, notice=20.0, repair=40.0, interrupted=0.02, spread=0.4)
    for seed in range(5):
        found = simulate(60, [chain], hard, 40.0, seed, longest_first=bool(seed % 2))
        assert 0 <= found.idle < 1 and 0 < found.store_use <= 1 + 1e-9 and 0 < found.efficiency < 1
        assert found.moved_bytes >= 0.99 * 60 * 0.5 * 4.6e8


@pytest.mark.parametrize(
    ("seconds", "pack", "groups"),
    [
        ([10, 10, 10], 0, [[0], [1], [2]]),
        ([50, 100, 20, 30], 120, [[0, 1, 2, 3]]),
        ([50, 100, 20, 130, 5], 120, [[0, 1], [2, 3, 4]]),
        ([10], 120, [[0]]),
        ([10, 200], float("inf"), [[0, 1]]),
    ],
)
def test_grouping_of_stages(seconds: list[float], pack: float, groups: list[list[int]]) -> None:
    assert [list(group) for group in group_stages(seconds, pack)] == groups


def test_tables_from_a_file_of_costs(tmp_path) -> None:  # type: ignore[no-untyped-def]
    costs = Costs((Kind("toy", "smoke", 3, 10, tuple(CHAIN), (1.0, 2.0)),), 2.0, 0.01, 0.001)
    (tmp_path / "costs.json").write_text(json.dumps(asdict(costs)))
    read = read_costs(tmp_path / "costs.json")
    assert read == costs
    row = run("size", 20, farm(read, 2), 60.0, read, 2)
    assert 0.5 < row.efficiency < 1 and "| 20 | 2 | 60 s | longest first | 10 |" in table([row])


def test_bytes_that_a_stage_reads() -> None:
    sizes = {name: 10.0**k for k, name in enumerate(REGISTRY.names)}
    for stage in REGISTRY.up_to():
        needed = [name for name in REGISTRY.names if name in stage.needs]
        found = bytes_read(stage.name, sizes, dict.fromkeys(stage.sources, 0.5))
        assert found == sum(sizes[name] for name in needed) + 0.5 * len(stage.sources)
    assert bytes_read("ingest", sizes, {"photos": 7.0}) >= 7.0


def test_the_longest_start_first() -> None:
    """Seven jobs on three slots: longest first takes 11/9 of the shortest time, its worst case for three (Graham 1969, theorem 3)."""
    kinds = [[StageCost("a", seconds, 0.0, 0.0)] for seconds in (300.0, 400.0, 300.0, 500.0, 400.0, 300.0, 500.0)]
    assert simulate(7, kinds, Farm(nodes=3, slots=1), 0.0).makespan == pytest.approx(1100.0)
    assert simulate(7, kinds, Farm(nodes=3, slots=1), 0.0, longest_first=False).makespan == pytest.approx(1200.0)
    known, guessed = Farm(nodes=5, spread=0.5), Farm(nodes=5, spread=0.5, misjudged=2.0)
    assert (
        mean(simulate(50, [CHAIN], guessed, 0.0, seed).makespan / simulate(50, [CHAIN], known, 0.0, seed).makespan for seed in range(9))
        > 1.02
    )
