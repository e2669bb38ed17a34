"""Tables of captures: photos alone, stereo, sharpness of textures, and what each rule of `[skip]` saves and costs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarks.lab.tables import Maker, Table, change, newest, number, read, spaced
from gsbake.config.schema import Skip


def photos(results: Path) -> Table:
    """Captures from their photos alone."""
    lines = newest(read(results, "photos"), "capture", "profile")
    rows = []
    for line in lines:
        masks = f"{line['masks']} of {line['photos']}" if line["masks"] != "0" else "not used"
        overlap = f"{number(line['overlap_median'], 3)} ({number(line['overlap_worst'], 3)})" if line["overlap_median"] else "–"
        shown = f"{line['registered']} of {line['photos']}", number(line["reprojection_px"], 2), number(line["agreement"], 2), masks
        rows.append([spaced(line["capture"]), *shown, overlap, number(line["left_out_pct"], 1), number(line["cpu_s"], 0)])
    headings = ("capture", "registered", "reprojection px", "agreement", "masks", "overlap, worst", "left out %", "CPU s")
    return Table("python -m benchmarks.photos", headings, rows, lines)


def stereo(results: Path) -> Table:
    """Stereo's points and the hull against ground truth."""
    lines = newest(read(results, "stereo"), "capture", "profile")
    rows = []
    for line in lines:
        errors = ", ".join(number(line[column], 3) for column in ("mean_pct", "median_pct", "p95_pct"))
        hull = change(line["hull_pct"], line["carved_pct"], 3)
        shown = number(line["confirmed_pct"], 0), line["points"], errors, number(line["normal_deg"], 1), hull
        rows.append([line["capture"], *shown, number(line["cpu_s"], 0)])
    headings = ("capture", "confirmed %", "points", "mean, median, 95 % quantile %", "normals °", "hull, Chamfer %", "CPU s")
    return Table("python -m benchmarks.stereo", headings, rows, lines)


def sharpness(results: Path) -> Table:
    """Textures beside photos or true colours at the larger of the measured sizes."""
    lines = newest(read(results, "sharpness"), "capture", "profile", "settings", "texture", "beside", "size")
    largest: dict[str, int] = {}
    for line in lines:
        largest[line["capture"]] = max(largest.get(line["capture"], 0), int(line["size"]))
    lines = [line for line in lines if int(line["size"]) == largest[line["capture"]]]
    rows = []
    for line in lines:
        texture = " ".join([line["texture"], *line["settings"].split()])
        figures = [number(line[column], digits) for column, digits in (("psnr", 1), ("detail", 2), ("aligned_2", 2), ("shift", 2))]
        rows.append([f"{spaced(line['capture'])}, {line['profile']}", texture, line["beside"], line["size"], *figures])
    headings = ("capture", "texture", "beside", "pixels", "PSNR dB", "detail", "aligned 2–4 px", "shift px")
    return Table("python -m benchmarks.sharpness OUT", headings, rows, lines)


def skip(results: Path) -> Table:
    """Every rule: with its work done, and with it left out."""
    measured = newest(read(results, "skip"), "capture", "profile", "rule", "mode")
    known = {(x["capture"], x["profile"], x["rule"], x["mode"]): x for x in measured}
    rows, lines = [], []
    for capture, profile, rule in dict.fromkeys((x["capture"], x["profile"], x["rule"]) for x in measured):
        if rule not in Skip.model_fields:
            continue
        whole = known[capture, profile, "all", "auto"]
        done, left = (known.get((capture, profile, rule, mode), whole) for mode in ("keep", "skip"))
        lines += [done, left]
        columns = (("cpu_s", 0), ("chamfer_pct", 3), ("psnr", 1), ("megabytes", 2))
        figures = [change(done[name], left[name], digits) for name, digits in columns]
        rows.append([rule, capture.replace("-capture", ""), profile, *figures])
    headings = ("rule", "capture", "profile", "CPU s", "Chamfer %", "PSNR dB", "MB")
    return Table("python -m benchmarks.skip CAPTURE --profile PROFILE", headings, rows, lines)


TABLES: Mapping[str, Maker] = {"photos": photos, "stereo": stereo, "sharpness": sharpness, "skip": skip}
