"""`gsbake synth`: the built-in synthetic capture."""

from __future__ import annotations

import time
from pathlib import Path

from gsbake.cli.output import print_json, print_text
from gsbake.errors import BadInputError
from gsbake.pipeline.files import disk_error
from gsbake.synth.folder import require_capture_folder
from gsbake.text import duration


def synth(
    folder: Path, *, views: int, size: int, seed: int, poses: bool, background: bool, marker: bool, dry_run: bool, quiet: bool,
    as_json: bool,
) -> None:  # fmt: skip
    """Write the capture and print its folder."""
    start = time.perf_counter()
    require_capture_folder(folder)
    if not dry_run:
        from gsbake.synth.capture import write_capture

        try:
            write_capture(folder, views=views, size=size, seed=seed, poses=poses, background=background, marker=marker)
        except OSError as error:
            raise disk_error(error, folder) or BadInputError(f"The capture cannot be written to '{folder}': {error.strerror}.") from error
    if as_json:
        print_json({"folder": str(folder), "views": views, "size": size, "seed": seed, "written": not dry_run}, indent=None)
    elif not quiet:
        done = "would be written" if dry_run else f"written in {duration(time.perf_counter() - start)}"
        print_text(f"{folder}: {views} photos of {size} × {size} pixels {done}")
