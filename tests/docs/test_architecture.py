"""The order of the folders: docs/reference/architecture.md and the contracts of import-linter in pyproject.toml say the same."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TABLES = (ROOT / "docs/reference/architecture.md").read_text(encoding="utf-8")


CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]


def contract_rows(container: str) -> list[set[str]]:
    """Names in each layer of a package's contract, from the top. It must name every folder and module."""
    found = next(c for c in CONTRACTS if c["type"] == "layers" and c["containers"] == [container])
    assert found["exhaustive"]
    return [set(re.findall(r"\w+", layer)) for layer in found["layers"]]


def table_rows(first: str, prefix: str) -> list[set[str]]:
    """Names in the first cell of each row of the table whose first row begins with `first`, without `prefix` and ".py"."""
    rows = TABLES[TABLES.index(f"| `{first}`") :].partition("\n\n")[0].splitlines()
    cells = [re.findall(r"`([^`]+)`", row.split("|")[1]) for row in rows]
    return [{name.removeprefix(prefix).removesuffix("/").removesuffix(".py") for name in cell} for cell in cells]


def test_the_table_has_the_rows_of_the_contract() -> None:
    """The contract in turn fails for a folder or module that it does not name."""
    assert table_rows("gsbake/__main__.py", "gsbake/") == contract_rows("gsbake")
    assert table_rows("training/", "") == contract_rows("gsbake.surfels")


def test_every_folder_of_the_library_is_kept_from_the_engine() -> None:
    found = next(c for c in CONTRACTS if c.get("forbidden_modules") == ["gsbake.pipeline"])
    rows = contract_rows("gsbake")
    library = set().union(*rows[rows.index({"publish"}) + 1 : rows.index({"pipeline"})])
    assert {name.removeprefix("gsbake.") for name in found["source_modules"]} == library


def test_the_library_does_not_import_the_stages() -> None:
    """Where gsbake.stages is no folder of the package on the disk, import-linter does not see its imports."""
    layers = [name for row in contract_rows("gsbake") for name in sorted(row)]
    below = layers[layers.index("stages") + 1 :]
    paths = [p for name in below for p in [ROOT / "gsbake" / f"{name}.py", *(ROOT / "gsbake" / name).rglob("*.py")] if p.exists()]
    assert len(paths) > 200
    importers = []
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [f"{node.module}.{a.name}" for a in node.names] if isinstance(node, ast.ImportFrom) else []
            importers += [path.name for name in names if f"{name}.".startswith(("gsbake.stages.", "stages."))]
    assert not importers
