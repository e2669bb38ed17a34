"""A batch on a farm, simulated from measured costs: how long it takes, how well nodes are used, and what limits it.

python -m benchmarks.farm [--costs FILE] [--seeds 3] [--csv FILE]

Reads what `python -m benchmarks.farm_costs` measured. Four tables: job packing (expected seconds below which a job takes the next stage)
for 100 captures on 10 nodes and 1 000 on 100; the order of jobs; 100, 1 000 and 10 000 captures on 10 to 1 000 nodes; and a shared store
of less bandwidth. The model is in `benchmarks/farm_model.py`; ASSUMPTIONS is what it assumes beyond the measured costs. Every figure is
the mean over seeds. Writes benchmarks/results/farm.csv.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from statistics import mean

from benchmarks.csv_rows import today
from benchmarks.farm_costs import RESULTS as COSTS
from benchmarks.farm_costs import Costs, read_costs
from benchmarks.farm_model import Farm, Result, simulate
from benchmarks.timeline import ROOT
from gsbake.batch.jobs import PACK_SECONDS

RESULTS = ROOT / "benchmarks" / "results" / "farm.csv"
WHOLE = float("inf")
PACKINGS = (0.0, 30.0, 60.0, 120.0, 300.0, WHOLE)
SIZES = ((100, 10), (100, 100), (1000, 10), (1000, 100), (1000, 1000), (10_000, 100), (10_000, 1000))
STORE_RATES = (1.25e9, 6.25e8, 3.125e8, 1.25e8, 3.1e7)
#: What is assumed, in the words of the documentation; the values are those of `farm`.
ASSUMPTIONS = (
    "A node has two cores and bakes two captures at once, one thread each, as fast as a thread of the measured machine; two side by side "
    "do not slow each other down.",
    "A capture is one of the measured ones, all of its times and bytes multiplied by one log-normal factor (standard deviation 0.3) and "
    "each stage's time by another (0.1). Expected times, by which jobs are packed and ordered, are off by a third one (0.2).",
    "All stages read their inputs from, and write their outputs to, one store of 10 Gbit/s, shared equally; a node has 1 Gbit/s, its two "
    "slots half each. Nothing is kept on nodes. Metadata and latency cost nothing.",
    "Nodes fail every 500 hours on average and lose the stage in progress of each job (no checkpoints); the loss is noticed after 5 "
    "minutes, the node is back after 15. One job in a hundred is interrupted somewhere in its first stage.",
    "The coordinator submits one job after another, and looks at the queue every 20 seconds; the file system shows files at once.",
    "Slurm itself costs nothing; jobs start in 64 classes by the expected time to the end of their captures, longest first; no other user "
    "is on the farm.",
)


@dataclass(frozen=True)
class Row:
    """A simulated batch; `pack_seconds` is inf where a capture is one job. Shares are of all slots' time; rates in bytes per second."""

    part: str
    order: str
    captures: int
    nodes: int
    pack_seconds: float
    store_rate: float
    hours: float
    efficiency: float
    overhead: float
    transfer: float
    lost: float
    idle: float
    gigabytes: float
    store_use: float
    coordinator_use: float
    jobs: int
    failures: float
    date: str = field(default_factory=today)


def farm(costs: Costs, nodes: int) -> Farm:
    """The farm of ASSUMPTIONS with the measured costs."""
    return Farm(
        nodes=nodes, start=costs.job_start, submit=costs.submit, plan=costs.plan, look=20.0, node_hours=500.0, interrupted=0.01, spread=0.3,
        noise=0.1, misjudged=0.2,
    )  # fmt: skip


def run(part: str, captures: int, described: Farm, pack_seconds: float, costs: Costs, seeds: int, *, longest_first: bool = True) -> Row:
    """The mean over seeds."""
    kinds = [kind.stages for kind in costs.kinds]
    found: list[Result] = [simulate(captures, kinds, described, pack_seconds, seed, longest_first=longest_first) for seed in range(seeds)]

    def average(name: str) -> float:
        return mean(float(getattr(result, name)) for result in found)

    return Row(
        part, "longest first" if longest_first else "as submitted", captures, described.nodes, pack_seconds, described.store_rate,
        average("makespan") / 3600, average("efficiency"), average("overhead"), average("transfer"), average("lost"), average("idle"),
        average("moved_bytes") / 1e9, average("store_use"), average("coordinator_use"), round(average("jobs")), average("failures"),
    )  # fmt: skip


def rows(costs: Costs, seeds: int) -> list[Row]:
    """All four tables."""
    found = [run("packing", 100, farm(costs, 10), pack, costs, 5 * seeds) for pack in PACKINGS]
    found += [run("packing", 1000, farm(costs, 100), pack, costs, seeds) for pack in PACKINGS]
    for longest_first in (False, True):
        found.append(run("order", 100, farm(costs, 10), PACK_SECONDS, costs, 5 * seeds, longest_first=longest_first))
    for captures, nodes in SIZES:
        found.append(run("size", captures, farm(costs, nodes), PACK_SECONDS, costs, seeds if captures < 10_000 else 1))
    for rate in STORE_RATES:
        found.append(run("store", 1000, replace(farm(costs, 100), store_rate=rate), PACK_SECONDS, costs, seeds))
    return found


def table(found: Sequence[Row]) -> str:
    """The rows as Markdown."""
    lines = [
        "| captures | nodes | jobs of | order | store Gbit/s | hours | efficiency | starting | transfers | lost | idle | GB moved | "
        "store | coordinator | jobs |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in found:
        pack = "a stage" if not row.pack_seconds else "a capture" if row.pack_seconds == WHOLE else f"{row.pack_seconds:.0f} s"
        shares = [f"{100 * v:.1f} %" for v in (row.overhead, row.transfer, row.lost, row.idle)]
        cells = [
            str(row.captures), str(row.nodes), pack, row.order, f"{8 * row.store_rate / 1e9:.2g}", f"{row.hours:.2f}",
            f"{row.efficiency:.3f}", *shares, f"{row.gigabytes:.0f}", f"{100 * row.store_use:.0f} %",
            f"{100 * row.coordinator_use:.1f} %", str(row.jobs),
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def write_csv(path: Path, found: Sequence[Row]) -> None:
    """Write the rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(Row)], lineterminator="\n")
        writer.writeheader()
        for row in found:
            writer.writerow({k: round(v, 5) if isinstance(v, float) else v for k, v in asdict(row).items()})


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate, print the tables and the assumptions, write the CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--costs", type=Path, default=COSTS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--csv", type=Path, default=RESULTS)
    args = parser.parse_args(arguments)
    found = rows(read_costs(args.costs), args.seeds)
    write_csv(args.csv, found)
    for part in dict.fromkeys(row.part for row in found):
        sys.stdout.write(f"{part}\n{table([row for row in found if row.part == part])}\n")
    sys.stdout.write("".join(f"- {text}\n" for text in ASSUMPTIONS))


if __name__ == "__main__":
    main()
