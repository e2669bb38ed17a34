"""Tables of the files of targets: bytes, triangles and error of each, and the levels of detail."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarks.lab.tables import Line, Maker, Table, newest, number, read, spaced

#: Targets that are shown: `ar` has the meshes and textures of `web`, others are of earlier versions.
TARGETS = ("default", "web", "banner", "default:ktx2+meshopt")
COMMAND = "python -m benchmarks.targets OUT"


def _files(results: Path) -> list[Line]:
    lines = [line for line in read(results, "targets") if line["target"] in TARGETS]
    found = newest(lines, "capture", "target", "level")
    return sorted(found, key=lambda x: (x["capture"], TARGETS.index(x["target"]), int(x["level"])))


def targets(results: Path) -> Table:
    """The first level of every target."""
    lines = [line for line in _files(results) if line["level"] == "0"]
    rows = []
    for line in lines:
        relit = f"{number(line['relight_psnr'], 1)} ({number(line['relight_psnr_scaled'], 1)})" if line["relight_psnr"] else "–"
        size = number(line["bytes"], 2, 1e-6), line["triangles"], line["texture"]
        rows.append([spaced(line["capture"]), f"`{line['target']}`", *size, number(line["chamfer_pct"], 3), relit])
    headings = ("capture", "target", "MB", "triangles", "texels", "Chamfer %", "relit dB")
    return Table(COMMAND, headings, rows, lines)


def levels(results: Path) -> Table:
    """Coarser levels of detail of the target `default`, plain and compressed."""
    plain = [line for line in _files(results) if line["target"] == "default" and line["level"] != "0"]
    packed = {(x["capture"], x["level"]): x for x in _files(results) if x["target"] == "default:ktx2+meshopt"}
    rows = []
    for line in plain:
        other = packed[line["capture"], line["level"]]
        shape = line["triangles"], number(line["chamfer_pct"], 3)
        rows.append([spaced(line["capture"]), line["level"], *shape, number(line["bytes"], 2, 1e-6), number(other["bytes"], 2, 1e-6)])
    headings = ("capture", "level", "triangles", "Chamfer %", "MB", "MB, ktx2 and meshopt")
    return Table(COMMAND, headings, rows, [*plain, *packed.values()])


TABLES: Mapping[str, Maker] = {"targets": targets, "levels": levels}
