"""The page's scripts, read without a browser: their text is in one file, none sets markup, and no two import each other."""

from __future__ import annotations

import re
from graphlib import TopologicalSorter
from importlib import resources

WEB = {
    entry.name: entry.read_text(encoding="utf-8")
    for entry in resources.files("gsbake.studio").joinpath("web").iterdir()
    if entry.name.endswith((".js", ".html"))
}
STRINGS = WEB["strings.js"]


def test_every_text_that_a_script_names_exists_and_is_used() -> None:
    known = set(re.findall(r"(?m)^  (\w+):", STRINGS))
    used = {name for file, text in WEB.items() if file != "strings.js" for name in re.findall(r"(?<![\w.])t\.(\w+)", text)}
    assert used - known == set() and known - used == set()


def test_text_is_set_as_text() -> None:
    for file, text in WEB.items():
        for way in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "new Function", 'setAttribute("style"'):
            assert way not in text, (file, way)
    assert not re.search(r"<script(?![^>]*src=)|\son\w+=|style=", WEB["index.html"])


def test_scripts_import_downwards_and_only_their_own() -> None:
    named = re.compile(r"""(?:from|import\()\s*["']([^"']+)["']""")
    imports = {file: set(named.findall(text)) for file, text in WEB.items() if file.endswith(".js")}
    for file, names in imports.items():
        assert all(name.startswith("./") or name == "/web/vendor/three.module.min.js" for name in names), file
    graph = {file: {name.removeprefix("./") for name in names if name.startswith("./")} for file, names in imports.items()}
    assert len(list(TopologicalSorter(graph).static_order())) == len(graph)


def test_vendored_files_are_the_ones_their_notes_name() -> None:
    import hashlib

    folder = resources.files("gsbake.studio").joinpath("web", "vendor")
    digest = hashlib.sha256(folder.joinpath("three.module.min.js").read_bytes()).hexdigest()
    assert digest in folder.joinpath("README.txt").read_text(encoding="utf-8")
    assert "MIT" in folder.joinpath("LICENSE.three.txt").read_text(encoding="utf-8")
