"""Commands on any glTF file: `inspect`, `compare`, `render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gsbake.cli.gates import COMPARED, bounds_parser
from gsbake.cli.options import JsonOption, QuietOption, ReplaceFileOption, given_path
from gsbake.cli.panels import Panel, command

file_app = typer.Typer()

FileArgument = Annotated[Path, typer.Argument(parser=given_path, metavar="FILE", help="A .glb or .gltf file.")]
LightOption = Annotated[
    str, typer.Option("--light", metavar="NAME|FILE", help="studio, sunset, hdr (light.hdr beside FILE), or an HDR image.")
]


@command(file_app, "inspect", Panel.FILES)
def inspect_command(
    file: FileArgument,
    as_json: JsonOption = False,
) -> None:
    """Show what is in any glTF file: meshes, textures, sizes, extensions, audit."""
    from gsbake.cli.file_tools import inspect

    inspect(file, as_json)


@command(file_app, "compare", Panel.FILES)
def compare_command(
    first: Annotated[Path, typer.Argument(parser=given_path, metavar="A", help="A .glb or .gltf file.")],
    second: Annotated[Path, typer.Argument(parser=given_path, metavar="B", help="Another, in the same frame.")],
    truth: Annotated[
        Path | None,
        typer.Option("--truth", parser=given_path, metavar="MESH", help="Mesh that both are measured against.", show_default=False),
    ] = None,
    sheet: Annotated[
        Path | None,
        typer.Option("--sheet", parser=given_path, metavar="PNG", help="Write renders of both and their difference.", show_default=False),
    ] = None,
    fail_under: Annotated[
        list[Any] | None,
        typer.Option(
            "--fail-under",
            parser=bounds_parser(COMPARED),
            metavar="KEY=VALUE,...",
            show_default=False,
            help="End with exit code 3 where a figure of --json is worse, as in render_psnr=30,chamfer=0.002. Repeatable.",
        ),
    ] = None,
    light: LightOption = "studio",
    views: Annotated[int, typer.Option("--views", min=1, max=64, help="Number of cameras.")] = 4,
    size: Annotated[int, typer.Option("--size", min=16, max=2048, help="Edge of the renders in pixels.")] = 384,
    overwrite: ReplaceFileOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare two glTF files: surfaces, normals, textures and renders."""
    from gsbake.cli.file_tools import compare

    bounds = [bound for group in fail_under or () for bound in group]
    compare(first, second, truth, sheet, bounds, light, views, size, as_json, overwrite)


@command(file_app, "render", Panel.FILES)
def render_command(
    file: FileArgument,
    turntable: Annotated[
        Path, typer.Option("--turntable", parser=given_path, metavar="FILE", help="Output: .mp4, .webp or .png (a sheet).")
    ],
    light: LightOption = "studio",
    views: Annotated[int, typer.Option("--views", min=1, max=2000, help="Number of views around the object.")] = 72,
    size: Annotated[int, typer.Option("--size", min=16, max=2048, help="Edge of the renders in pixels.")] = 512,
    samples: Annotated[int, typer.Option("--samples", min=1, max=8, help="Rays along each edge of a pixel.")] = 2,
    overwrite: ReplaceFileOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Render a turntable of any glTF file, without a GPU."""
    from gsbake.cli.file_tools import render

    render(file, light, turntable, views, size, samples, as_json, quiet, overwrite)
