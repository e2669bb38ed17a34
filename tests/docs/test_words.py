"""Words are those of the glossary: old words for the same things appear neither in names nor in prose."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: Old word (a regular expression, matched as a whole word, also within snake_case and CamelCase names) → what is meant.
OLD_WORDS = {
    "paint(s|ed|ing)?": "dielectric, or base colour",
    "matte?": "diffuse",
    "lights?'s? level|level of the light": "light intensity",
    "by[_ ]eye": "perceptual",
    "bends?|bent|bending": "normal correction, or deflection",
    "told": "detected, distinguished, given",
    "alike": "similar",
    "plainer": "map selection",
    "parsimony": "reflectance sparsity prior",
    "delit": "delighted",
    "polish(es|ed|ing)?": "refinement",
    "nobody foresaw": "internal error",
    "will not do": "state what is wrong",
    "the person": "the user",
}
#: What may stand nevertheless, by the whole phrase: names of objects, a material, a library, quoted titles and fixed terms.
ALLOWED = (
    r"painted,? (chipped )?(helmet|stool)",
    r"painted, chipped helmet",
    r"polished (copper|metal|steel|surfaces?)",
)
#: What is searched.
PROSE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs")
CODE = ("gsbake", "stages", "profiles", "tests", "benchmarks")
SUFFIXES = {".md", ".py", ".toml", ".j2", ".js", ".css"}
#: This list itself.
SKIPPED = {"tests/docs/test_words.py"}


def words_of(text: str) -> list[tuple[int, str, str]]:
    """(line, old word, what is meant) of every hit in the text."""
    # fooBar → foo_Bar, so that parts of names are whole words
    plain = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", text)
    for phrase in ALLOWED:
        plain = re.sub(rf"(?i){phrase}", lambda hit: "x" * 3 + "\n" * hit[0].count("\n"), plain)
    hits = []
    for word, meant in OLD_WORDS.items():
        for hit in re.finditer(rf"(?i)(?<![a-z])(?:{word})(?![a-z])", plain):
            hits.append((plain.count("\n", 0, hit.start()) + 1, hit[0], meant))
    return sorted(hits)


def files_below(name: str) -> list[Path]:
    start = ROOT / name
    found = [start] if start.is_file() else sorted(start.rglob("*"))
    return [
        path
        for path in found
        if path.suffix in SUFFIXES
        and not {"vendor", "__pycache__", "node"} & set(path.parts)
        and path.relative_to(ROOT).as_posix() not in SKIPPED
        and not any(parent.is_symlink() for parent in path.parents)
    ]


@pytest.mark.parametrize("name", [*PROSE, *CODE])
def test_no_old_words(name: str) -> None:
    hits = [
        f"{path.relative_to(ROOT)}:{line}: '{word}' ({meant})"
        for path in files_below(name)
        for line, word, meant in words_of(path.read_text(encoding="utf-8"))
    ]
    assert not hits, f"{len(hits)} old words, for example\n" + "\n".join(hits[:60])


def test_the_search_finds_names_and_prose() -> None:
    assert words_of("paint_color = bakePaint(matt)\n# the light's level was told")
    assert not words_of("import matplotlib\ninpainting(a painted stool)\nmatter = formatted")
