"""Write the tables of docs/lab and of README.md from the rows in benchmarks/results.

python -m benchmarks.lab [--pages DIR] [--results DIR]

A page is hand-written but for its tables: what stands between `<!-- table: NAME -->` and `<!-- end -->` is replaced by the table of that
name (`benchmarks.lab.pages.TABLES`), with the date of its rows and the command that measures them. Nothing is measured here.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.lab.pages import PAGES, README, RESULTS, PageError, filled


def main(arguments: Sequence[str] | None = None) -> int:
    """Rewrite the pages that changed and name them; exit code 1 for wrong markers or missing results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pages", type=Path, default=PAGES)
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    try:
        for page in (*sorted(options.pages.glob("*.md")), *([README] if options.pages == PAGES else [])):
            text = page.read_text(encoding="utf-8")
            if (made := filled(text, page.name, options.results)) != text:
                page.write_text(made, encoding="utf-8")
                sys.stdout.write(f"{page}\n")
    except (PageError, OSError) as error:
        sys.stderr.write(f"lab: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
