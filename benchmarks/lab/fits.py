"""Tables of shape and materials: objects with known materials, parts of the fit, what each rule of the fit brings."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from benchmarks.ceiling_rows import TRUE, TRUE_NORMALS, beside, beside_pair, ceilings
from benchmarks.ceiling_rows import newest as newest_ceilings
from benchmarks.lab.tables import Line, Maker, Table, newest, number, read, signed, spaced

#: Names of the rows of `benchmarks.materials` that are shown.
PARTS = {
    "projected": "surfels' materials projected",
    "fit": "texture fit, no priors, no shadows",
    "reflections": "+ visibility, bounce, reflections",
    "priors": "+ priors but sparsity",
    "sparsity": "+ sparsity",
}
OBJECT_HEADINGS = ("object", "metal", "Chamfer %", "relit dB", "true normals, dB", "base colour dB", "roughness", "metallic")
#: Names of the rows of `benchmarks.ceiling`, and the views that the parts are scored on.
CEILINGS, PART_VIEWS = {TRUE: "true maps, newest mesh", TRUE_NORMALS: "+ true normals"}, 3


def _object(line: Line, results: Path) -> list[str]:
    def figure(column: str) -> float:
        return float(line[column])

    found = ceilings(line["object"], figure("chamfer_pct"), results / "ceiling.csv")
    true, normals = found.get(TRUE), found.get(TRUE_NORMALS)
    relit, base = (beside_pair(figure, true, column) for column in ("relit", "base"))
    maps = (beside(figure(column), true, column, 3) for column in ("roughness", "metallic"))
    upper = beside_pair(partial(getattr, normals), None, "relit") if normals else "–"
    return [spaced(line["object"]), line["metal"], number(line["chamfer_pct"], 3), relit, upper, base, *maps]


def _objects(results: Path, photos: bool) -> list[Line]:
    lines = [line for line in read(results, "objects") if line["profile"] == "relight" and not line["settings"]]
    return sorted(newest((x for x in lines if x["object"].endswith("_photos") == photos), "object"), key=lambda x: x["object"])


def objects(results: Path) -> Table:
    """The newest row of every object from given poses and masks, and their medians."""
    lines = _objects(results, photos=False)
    rows = [_object(line, results) for line in lines]

    def median(column: str) -> str:
        return str(statistics.median(float(line[column]) for line in lines))

    columns = ("chamfer_pct", "relit", "relit_scaled", "base", "base_scaled", "roughness", "metallic")
    rows.append(_object({"object": "**median**", "metal": ""} | {column: median(column) for column in columns}, results))
    return Table("python -m benchmarks.objects OUT", OBJECT_HEADINGS, rows, lines)


def objects_alone(results: Path) -> Table:
    """The newest row of every object on a table, from photos alone."""
    lines = _objects(results, photos=True)
    command = f"python -m benchmarks.objects OUT --only {','.join(line['object'] for line in lines)}"
    return Table(command, OBJECT_HEADINGS, [_object(line, results) for line in lines], lines)


def parts(results: Path) -> Table:
    """Rows of `benchmarks.materials`, each with everything of the one above, and below those of a capture its ceilings."""
    lines = newest((x for x in read(results, "materials") if x["row"] in PARTS), "capture", "row")
    rows, dated = [], list(lines)
    for capture in dict.fromkeys(line["capture"] for line in lines):
        for line in (x for x in lines if x["capture"] == capture):
            relit = f"{number(line['relight_psnr'], 1)} ({number(line['relight_psnr_scaled'], 1)})"
            maps = number(line["roughness_rmse"], 3), number(line["metallic_rmse"], 3)
            figures = number(line["psnr"], 1), relit, number(line["albedo_psnr_scaled"], 1), *maps, number(line["cpu_s"], 0)
            rows.append([capture if line["row"] == "projected" else "", PARTS[line["row"]], *figures])
        for name, row in newest_ceilings(capture, results / "ceiling.csv", PART_VIEWS).items():
            if name in CEILINGS:
                relit, texels = beside_pair(partial(getattr, row), None, "relit"), (f"{row.roughness:.3f}", f"{row.metallic:.3f}")
                rows.append(["", CEILINGS[name], "–", relit, f"{row.base_scaled:.1f}", *texels, "–"])
                dated.append({"date": row.date})
    headings = ("capture", "with", "held out dB", "relit dB", "base colour dB, with gains", "roughness", "metallic", "CPU s")
    return Table(f"python -m benchmarks.materials --views {PART_VIEWS}", headings, rows, dated)


def rules(results: Path) -> Table:
    """What leaving out a rule of the fit changes: mean over the objects, and the objects that lose and gain most."""
    lines = read(results, "ablation")
    whole = {(line["object"], line["commit"]): line for line in lines if line["rule"] == "none"}
    chosen = [x for x in newest((x for x in lines if x["rule"] != "none"), "object", "rule") if (x["object"], x["commit"]) in whole]
    rows = []
    for rule in sorted({line["rule"] for line in chosen}):
        pairs = [(line, whole[line["object"], line["commit"]]) for line in chosen if line["rule"] == rule]

        def shift(column: str, pairs: list[tuple[Line, Line]] = pairs) -> list[float]:
            return [float(without[column]) - float(with_[column]) for without, with_ in pairs]

        def both(column: str) -> str:
            return f"{signed(statistics.mean(shift(column)), 1)} ({signed(statistics.mean(shift(column + '_scaled')), 1)})"

        by_object = sorted(zip(shift("relit_scaled"), (spaced(line["object"]) for line, _ in pairs), strict=True))
        (lowest, loser), (highest, winner) = by_object[0], by_object[-1]
        ends = f"{signed(lowest, 1)} {loser}", f"{signed(highest, 1)} {winner}"
        rows.append([rule, str(len(pairs)), both("relit"), both("base"), signed(statistics.mean(shift("metallic")), 3), *ends])
    headings = ("left out", "objects", "relit dB", "base colour dB", "metallic", "most lost", "most gained")
    return Table("python -m benchmarks.ablation RUNS CAPTURES OUT --views 4", headings, rows, chosen)


TABLES: Mapping[str, Maker] = {"objects": objects, "objects alone": objects_alone, "parts": parts, "rules": rules}
