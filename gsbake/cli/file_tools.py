"""`gsbake inspect`, `compare` and `render`: tools on any glTF file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsbake.atomic import write_atomic
from gsbake.cli.gates import COMPARED, check_bounds, end_at_gate, gate_document
from gsbake.cli.output import cell, print_json, print_table, print_text
from gsbake.errors import BadInputError, UsageError
from gsbake.text import number, size


def inspect(path: Path, as_json: bool) -> None:
    """Print what is in a file, and the audit."""
    from gsbake.viewing.inspect import inspect_file

    figures = inspect_file(path)
    if as_json:
        print_json(figures)
        return
    print_text(f"{path}: {figures['container']}, {size(figures['bytes'])}, by {figures['generator'] or 'an unknown program'}")
    extent = " × ".join(number(x) for x in figures["bounds"]["size"])
    print_text(f"{number(figures['triangles'])} triangles, {number(figures['vertices'])} vertices, {extent} units")
    print_text(f"Extensions: {', '.join(figures['extensions']) or 'none'}")
    print_table(
        ("mesh", "triangles", "vertices", "UV sets", "material"),
        [(m["name"], number(m["triangles"]), number(m["vertices"]), len(m["uv_sets"]), m["material"]) for m in figures["meshes"]],
    )
    if figures["textures"]:
        rows = [
            (t["image"], ", ".join(t["roles"]), t["format"], f"{t['width']} × {t['height']}", size(t["bytes"])) for t in figures["textures"]
        ]
        print_table(("image", "used as", "format", "texels", "size"), rows)
    for note in figures["notes"]:
        print_text(f"Note: {note}.")
    wrong = [f for f in figures["audit"] if not f["passed"] and f["severity"] != "info"]
    if figures["audit"]:
        print_text(f"Audit: {len(figures['audit']) - len(wrong)} of {len(figures['audit'])} rules passed")
    if wrong:
        colours = {"error": "red", "warning": "yellow"}
        print_table(("rule", "severity", "found"), [(f["rule"], cell(f["severity"], colours[f["severity"]]), f["detail"]) for f in wrong])


def compare(
    first: Path,
    second: Path,
    truth: Path | None,
    sheet: Path | None,
    bounds: list[tuple[str, float]],
    light: str,
    views: int,
    pixels: int,
    as_json: bool,
    overwrite: bool,
) -> None:
    """Print figures of two files; write the sheet of their renders and differences; end with an exit code of its own outside `bounds`."""
    from gsbake.imaging.png import encode_png
    from gsbake.viewing.compare import compare_files
    from gsbake.viewing.lights import light_files, load_light
    from gsbake.viewing.turntable import check_output

    if truth is None and any(key.startswith("truth.") for key, _ in bounds):
        raise UsageError("--fail-under names a distance from the true mesh: give that with --truth.")
    if sheet is not None:
        inputs = [first, second, *([truth] if truth else []), *light_files(light, first.parent)]
        check_output(sheet, inputs, overwrite=overwrite, what="The sheet", suffixes=(".png",))
    figures, image = compare_files(first, second, truth, load_light(light, first.parent), views, pixels)
    if sheet is not None:
        try:
            write_atomic(sheet, encode_png(image, 6))
        except OSError as error:
            raise BadInputError(f"'{sheet}' cannot be written: {error.strerror}.") from error
        figures["sheet"] = str(sheet)
    values = figures["surface"] | figures["images"]
    if truth is not None:
        values |= {f"truth.{key}": value for key, value in figures["truth"]["surfaces"][1].items()}
    worse = check_bounds(bounds, values, COMPARED)
    if as_json:
        print_json(figures | gate_document(worse))
    else:
        _print_comparison(figures, truth, sheet)
    end_at_gate(worse)


def _print_comparison(figures: dict[str, Any], truth: Path | None, sheet: Path | None) -> None:
    rows: list[tuple[Any, ...]] = [(key, _figure(value)) for key, value in (figures["surface"] | figures["images"]).items()]
    print_table(("first and second file", "value"), rows)
    if truth is not None:
        names = list(figures["truth"]["surfaces"][0])
        a, b = figures["truth"]["surfaces"]
        print_table((f"against {truth.name}", "first", "second"), [(key, _figure(a[key]), _figure(b[key])) for key in names])
    if sheet is not None:
        print_text(f"{sheet}: first, second, and their difference")


def render(
    path: Path, light: str, turntable: Path, views: int, pixels: int, samples: int, as_json: bool, quiet: bool, overwrite: bool
) -> None:
    """Render a file from around and write the images."""
    from gsbake.gltf.scene import open_scene
    from gsbake.viewing.lights import light_files, load_light
    from gsbake.viewing.render import SceneRenderer
    from gsbake.viewing.turntable import check_output, frames, orbit, write_turntable

    check_output(turntable, [path, *light_files(light, path.parent)], overwrite=overwrite)
    scene = open_scene(path)
    shader = load_light(light, path.parent)
    renderer = SceneRenderer(scene)
    cameras = orbit(renderer.centre, renderer.radius, views, pixels)
    count = write_turntable(turntable, frames(renderer, cameras, shader, samples), overwrite=overwrite)
    if as_json:
        done = {"file": str(path), "turntable": str(turntable), "views": count, "size": pixels, "light": light}
        print_json(done | {"notes": list(scene.notes)})
    elif not quiet:
        for note in scene.notes:
            print_text(f"Note: {note}.")
        print_text(f"{turntable}: {count} views of {pixels} × {pixels} pixels")


def _figure(value: float | None) -> str:
    return "none" if value is None else number(value)
