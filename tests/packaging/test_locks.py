"""The locks: every pinned package at its pinned version with digests of its files; the runtime is a part of what developers install."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LOCKS = ("runtime", "dev")


def normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def entries(lock: str) -> dict[str, tuple[str, str]]:
    """{package: (version, the lines of its entry)}."""
    text = (ROOT / "packaging" / f"{lock}.lock").read_text(encoding="utf-8")
    found = [re.match(r"([A-Za-z0-9._-]+)==([^\s;]+)", entry) for entry in re.split(r"\n(?=\S)", text)]
    return {normalised(one[1]): (one[2], one.string) for one in found if one is not None}


def pins() -> dict[str, str]:
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    return {normalised(name): version for name, version in re.findall(r"(?m)^([A-Za-z0-9._-]+)==([A-Za-z0-9.+!]+)", text)}


def test_developers_install_every_pin_but_pytorch() -> None:
    assert {name: version for name, (version, _) in entries("dev").items()} == {k: v for k, v in pins().items() if k != "torch"}


def test_the_runtime_is_a_part_of_it() -> None:
    runtime, dev = entries("runtime"), entries("dev")
    assert all(dev[name][0] == version for name, (version, _) in runtime.items())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    needed = {normalised(re.match(r"[A-Za-z0-9._-]+", text)[0]) for text in project["project"]["dependencies"]}  # type: ignore[index]
    assert needed - {"torch"} <= runtime.keys() and not {"pytest", "mypy", "moto", "mkdocs"} & runtime.keys()
    assert project["build-system"]["requires"] == [f"hatchling=={runtime['hatchling'][0]}"]


@pytest.mark.parametrize("lock", LOCKS)
def test_every_entry_has_digests(lock: str) -> None:
    for name, (_, text) in entries(lock).items():
        assert re.search(r"--hash=sha256:[0-9a-f]{64}\b", text), name
