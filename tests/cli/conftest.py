"""Commands on toy stages, in this process."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from gsbake.cli import main
from tests.cli import toy_bake


@dataclass(frozen=True)
class End:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


Run = Callable[..., End]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Iterator[Run]:
    """Run a command on the toy stages, in this process and an empty working folder."""
    import gsbake.api

    monkeypatch.setattr(gsbake.api, "REGISTRY", toy_bake.REGISTRY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def command(*arguments: object) -> End:
        monkeypatch.setattr(sys, "argv", ["gsbake", *map(str, arguments)])
        code: Any = 0
        try:
            main()
        except SystemExit as error:
            code = error.code
        captured = capsys.readouterr()
        return End(int(code or 0), captured.out, captured.err)

    yield command
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    folder = tmp_path / "tankard"
    for name in ("images/a.jpg", "images/b.jpg", "images/c.jpg", "masks/a.png", "gt/secret.jpg"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    return folder
