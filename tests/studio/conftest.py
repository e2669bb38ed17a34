"""A studio over a folder of captures, asked without a browser."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.studio.server import MODULES, Studio
from gsbake.studio.workspace import Folder


def photo(number: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    """A photo (h, w, 3) with a bright disc on a dark ground, each a little different."""
    out = np.full((size[1], size[0], 3), 40 + number, np.uint8)
    cv2.circle(out, (size[0] // 2, size[1] // 2), size[1] // 4, (60, 120, 220), -1)
    return out


def write_capture(folder: Path, count: int = 4, suffix: str = ".jpg") -> Path:
    (folder / "images").mkdir(parents=True)
    for number in range(count):
        cv2.imwrite(str(folder / "images" / f"p{number}{suffix}"), photo(number))
    return folder


@dataclass(frozen=True)
class Answer:
    """The answer to a request."""

    code: int
    headers: Mapping[str, str]
    content: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.content)


@dataclass
class Browser:
    """Requests to a studio over `folder`, with the headers that the page sends along; without `cookie` those of a stranger."""

    studio: Studio
    folder: Path
    cookie: str = ""
    _connection: http.client.HTTPConnection | None = field(default=None, repr=False)

    @property
    def origin(self) -> str:
        return f"http://127.0.0.1:{self.studio.port}"

    def ask(self, method: str, path: str, content: bytes = b"", **headers: str | None) -> Answer:
        """One request; headers that are None are left out."""
        usual: dict[str, str | None] = {"Host": f"127.0.0.1:{self.studio.port}", "Cookie": self.cookie or None, "Origin": self.origin}
        sent = {name: value for name, value in {**usual, **headers}.items() if value is not None}
        if self._connection is None:
            self._connection = http.client.HTTPConnection("127.0.0.1", self.studio.port, timeout=30)
        self._connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, value in {**sent, "Content-Length": str(len(content))}.items():
            self._connection.putheader(name, value)
        try:
            self._connection.endheaders(content)
            found = self._connection.getresponse()
            return Answer(found.status, {k.lower(): v for k, v in found.getheaders()}, found.read())
        except (OSError, http.client.HTTPException):
            self.close()
            raise

    def get(self, path: str, code: int = 200) -> Any:
        """The JSON or the bytes at a path."""
        return self.send("GET", path, b"", code)

    def send(self, method: str, path: str, body: Any = None, code: int = 200) -> Any:
        """The answer's JSON or bytes; `body` is bytes or JSON."""
        found = self.ask(method, path, body if isinstance(body, bytes) else json.dumps(body or {}).encode())
        assert found.code == code, (found.code, found.content[:500])
        return found.json if "json" in found.headers.get("content-type", "") else found.content

    def stranger(self) -> Browser:
        """One without the cookie."""
        return Browser(self.studio, self.folder)

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


@pytest.fixture
def extra() -> None:
    for module in MODULES:
        pytest.importorskip(module, reason="the extra `studio` is not installed")


@pytest.fixture
def browser(extra: None, tmp_path: Path) -> Iterator[Browser]:
    folder = tmp_path / "captures"
    folder.mkdir()
    with Studio(Folder(folder)) as studio:
        browser = Browser(studio, folder)
        browser.cookie = browser.ask("GET", f"/?token={studio.token}").headers["set-cookie"].partition(";")[0]
        yield browser
        browser.close()
