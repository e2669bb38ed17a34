"""The site builds strictly, opens without a network, and names every setting, command and option."""

from __future__ import annotations

import html
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import gsbake
from gsbake.cli.app import app
from gsbake.config.load import fields

ROOT = Path(__file__).resolve().parents[2]
#: Pictures of the documentation are small.
MAX_BYTES = {"README": 300_000, "page": 150_000}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-W", "ignore", "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return out


def text_of(page: Path) -> str:
    return html.unescape(re.sub(r"<[^>]+>", "", page.read_text(encoding="utf-8")))


def test_every_setting_is_documented(site: Path) -> None:
    text = text_of(site / "reference" / "settings.html")
    for name, field in fields().items():
        if "." in name:
            assert re.search(rf"(?m)^{re.escape(name)}$", text), name
            assert field.description and " ".join(field.description.split()) in " ".join(text.split()), name


def test_every_command_and_option_is_documented(site: Path) -> None:
    page = (site / "reference" / "commands.html").read_text(encoding="utf-8")
    group = typer.main.get_command(app)
    groups = re.findall(r'(?s)<h2[^>]*>(.*?)<a', page)
    assert groups == ["Make", "Inspect", "Edit", "Many captures", "Files", "Single stages"]
    commands = group.commands | {f"cache-{name}": command for name, command in group.commands["cache"].commands.items()}  # type: ignore[attr-defined]
    for name, command in commands.items():
        part = page.split(f'id="gsbake-{name}"')
        assert len(part) == 2, name
        section = html.unescape(re.sub(r"<[^>]+>", "", re.split("<h[23]", part[1], maxsplit=1)[0]))
        for parameter in command.params:
            for option in (*parameter.opts, *parameter.secondary_opts):
                assert not option.startswith("-") or option in section, (name, option)


def test_nothing_is_fetched_from_elsewhere(site: Path) -> None:
    loaded = re.compile(r"""<(?:script|img|iframe|source)[^>]+src=["']?(https?:)?//|<link[^>]+rel=["']?(?:stylesheet|preconnect)[^>]+//""")
    for page in site.rglob("*.html"):
        assert not loaded.search(page.read_text(encoding="utf-8")), page


def test_pictures_are_small_and_used() -> None:
    pages = "".join(path.read_text(encoding="utf-8") for path in [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"])
    for picture in [path for path in (ROOT / "docs").rglob("*") if path.suffix in (".png", ".webp", ".jpg")]:
        assert picture.stat().st_size <= MAX_BYTES["page"], picture
        assert picture.name in pages, f"{picture} is on no page"


def test_the_script_that_makes_the_pictures_fits_the_code() -> None:
    path = ROOT / "docs" / "pictures.py"
    spec = importlib.util.spec_from_file_location("docs_pictures", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name in re.findall(r"\bcompose\.(\w+)", path.read_text(encoding="utf-8")):
        assert hasattr(module.compose, name), name


def test_the_changelog_keeps_its_form() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    first, *releases = re.findall(r"(?m)^## (.*)", text)
    assert first == "[Unreleased]"
    assert all(re.fullmatch(r"\[\d+\.\d+\.\d+\] - \d{4}-\d{2}-\d{2}", release) for release in releases)
    assert releases[0].startswith(f"[{gsbake.__version__}]")
    assert set(re.findall(r"(?m)^### (.*)", text)) <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def test_links_of_the_readme_and_its_companions_exist() -> None:
    for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        prose = re.sub(r"```.*?```", "", (ROOT / name).read_text(encoding="utf-8"), flags=re.S)
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", prose):
            assert (ROOT / target).exists(), f"{name} links to {target}"


def test_decisions_have_status_and_date() -> None:
    index = (ROOT / "docs" / "decisions" / "index.md").read_text(encoding="utf-8")
    for page in sorted((ROOT / "docs" / "decisions").glob("0*.md")):
        text = page.read_text(encoding="utf-8")
        assert re.search(r"(?m)^Status: (accepted|superseded|proposed|rejected)", text), page
        assert re.search(r"(?m)^Date: \d{4}-\d{2}-\d{2}$", text), page
        assert f"({page.name})" in index, page


def test_tables_of_measurements_follow_a_command() -> None:
    """Every section with a table says which command makes it, or that none does; of decisions at least the page."""
    command = re.compile(r"\bcommands?\b|`make |`gsbake |python -m benchmarks|cannot be remade", re.I)
    for page in sorted((ROOT / "docs" / "lab").glob("*.md")):
        for section in re.split(r"(?m)^(?=## )", page.read_text(encoding="utf-8"))[1:]:
            table = re.search(r"(?m)^\|", section)
            assert not table or command.search(section[: table.start()]) or "## Captures" in section, (page.name, section[:60])
    for page in sorted((ROOT / "docs" / "decisions").glob("0*.md")):
        text = page.read_text(encoding="utf-8")
        assert "\n|" not in text or command.search(text), page


def test_pages_named_in_the_code_exist() -> None:
    for folder in ("gsbake", "stages", "profiles", "tests", "benchmarks"):
        for path in (ROOT / folder).rglob("*.py"):
            for name in re.findall(r"\bdocs/[\w/-]+\.md", path.read_text(encoding="utf-8")):
                generated = name in ("docs/reference/settings.md", "docs/reference/commands.md")
                assert generated or (ROOT / name).is_file(), f"{path.relative_to(ROOT)} names {name}"


def test_quoted_error_sentences_are_in_the_code() -> None:
    """The headings of the troubleshooting page are the sentences that the program prints."""
    code = ""
    for path in sorted((ROOT / "gsbake").rglob("*.py")):
        code += re.sub(r"""["']\s*\n\s*f?["']""", "", path.read_text(encoding="utf-8"))
    page = (ROOT / "docs" / "guide" / "troubleshooting.md").read_text(encoding="utf-8")
    quoted = [part.strip() for heading in re.findall(r"(?m)^### (.*)", page) for part in re.findall(r"`([^`]+)`", heading)]
    assert len(quoted) > 15
    for sentence in quoted:
        for piece in filter(None, (piece.strip(" ,") for piece in sentence.split("…"))):
            assert piece in code, f"no error says '{piece}'"
