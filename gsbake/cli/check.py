"""`gsbake check PHOTOS`: what will go wrong in a bake, and what to do about it."""

from __future__ import annotations

import tempfile
import time
from dataclasses import asdict
from pathlib import Path

from gsbake.cli.output import print_json, print_text
from gsbake.pipeline.files import disk_error
from gsbake.pipeline.machine import default_threads
from gsbake.text import duration

#: Marks of the findings in text output.
MARKS = {"problem": "✗", "advice": "!", "good": "✓"}


def check(photos: Path, masks: Path | None, poses: Path | None, threads: int, as_json: bool) -> None:
    """Check the photos in a temporary folder and print the findings, worst first."""
    from gsbake.capture.check import check_photos
    from gsbake.capture.sources import discover

    start = time.perf_counter()
    found = discover(photos, masks, poses)
    with tempfile.TemporaryDirectory(prefix="gsbake-check-") as folder:
        try:
            findings, figures = check_photos(
                found.photos, Path(folder), masks=found.masks, poses=found.poses, threads=threads or default_threads()
            )
        except OSError as error:
            known = disk_error(error, Path(folder))
            if known is None:
                raise
            raise known from error
    seconds = time.perf_counter() - start
    if as_json:
        print_json({"findings": [asdict(finding) for finding in findings], "figures": figures, "seconds": round(seconds, 3)})
        return
    width = max(len(finding.about) for finding in findings)
    for finding in findings:
        print_text(f"{MARKS[finding.level]} {finding.about:<{width}}  {finding.text}{'. ' + finding.do if finding.do else ''}")
    counts = {level: sum(finding.level == level for finding in findings) for level in MARKS}
    problems = f"{counts['problem']} problem{'' if counts['problem'] == 1 else 's'}"
    advice = f"{counts['advice']} piece{'' if counts['advice'] == 1 else 's'} of advice"
    print_text(f"{problems}, {advice}, checked in {duration(seconds)}")
