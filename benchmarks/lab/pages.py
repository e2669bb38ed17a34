"""Pages of the lab: text with markers, between which stand tables that are made from the results."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from benchmarks.lab import assets, captures, farms, fits, headline, kernels, safety, systems
from benchmarks.lab.tables import Maker

ROOT = Path(__file__).resolve().parents[2]
PAGES, README, RESULTS = ROOT / "docs" / "lab", ROOT / "README.md", ROOT / "benchmarks" / "results"
#: Every table by the name that stands in its marker.
TABLES: Mapping[str, Maker] = {
    **assets.TABLES, **captures.TABLES, **farms.TABLES, **fits.TABLES, **headline.TABLES, **kernels.TABLES, **safety.TABLES,
    **systems.TABLES,
}  # fmt: skip
BLOCK = re.compile(r"<!-- table: (.*?) -->\n(.*?)<!-- end -->\n", re.S)


class PageError(Exception):
    """A page that cannot be filled, in one sentence."""


def filled(text: str, page: str, results: Path = RESULTS) -> str:
    """The page's text with every table as the results have it now. Raises PageError for unknown names and for markers that do not pair."""

    def block(found: re.Match[str]) -> str:
        name = found[1]
        if name not in TABLES:
            raise PageError(f"{page} has a marker for the table '{name}'; there are {', '.join(TABLES)}.")
        return f"<!-- table: {name} -->\n\n{TABLES[name](results).markdown()}\n\n<!-- end -->\n"

    starts, ends = len(re.findall(r"(?m)^<!-- table: ", text)), len(re.findall(r"(?m)^<!-- end -->$", text))
    if not starts == ends == len(BLOCK.findall(text)):
        raise PageError(f"{page} has {starts} markers '<!-- table: NAME -->' and {ends} '<!-- end -->' that do not pair.")
    return BLOCK.sub(block, text)
