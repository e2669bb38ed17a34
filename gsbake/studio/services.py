"""What the server keeps while it runs, none of which is lost with it: processes that decode and draw, checks, runs it started."""

from __future__ import annotations

import json
import shutil
import tempfile
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from blake3 import blake3

from gsbake.limited_process import ParserProcess, read_in_child
from gsbake.studio.checks import Checks
from gsbake.studio.images import Images
from gsbake.studio.run_processes import Runs
from gsbake.studio.workspace import Capture, NotFoundError

#: Module of the child that draws, seconds that a request may take, and seconds without one after which it ends.
DRAWER, SECONDS, IDLE = "gsbake.studio.view_process", 300.0, 60.0
#: Names of the files that it draws.
FILES = frozenset({"photo.jpg", "render.jpg", "error.jpg", "studio.hdr", "sunset.hdr"})


class Views:
    """Pictures of assets from the cameras of their photos, kept in the cache by what they show."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._child = ParserProcess(DRAWER)
        self._timer: threading.Timer | None = None

    def view(self, capture: Capture, folders: Mapping[str, Path], name: str) -> tuple[str, dict[str, Any]]:
        """Key and figures of the pictures from a photo's camera. Raises BadInputError for an asset that cannot be drawn."""
        key, request = _asset_request("view", folders, name)
        return key, self._drawn(capture, key, request)

    def lights(self, capture: Capture) -> str:
        """Key of the environment maps."""
        self._drawn(capture, "lights", {"task": "lights"})
        return "lights"

    def places(self, capture: Capture, folders: Mapping[str, Path]) -> list[dict[str, Any]]:
        """Directions for further photos."""
        places: list[dict[str, Any]] = self._drawn(capture, *_asset_request("places", folders))["places"]
        return places

    def file(self, capture: Capture, key: str, name: str) -> Path:
        """A file that was drawn. Raises NotFoundError."""
        path = capture.cache / "views" / key / name
        if name not in FILES or not key.isalnum() or not path.is_file():
            raise NotFoundError("There is no such picture.")
        return path

    def close(self) -> None:
        """End the child, also while it draws."""
        if self._timer is not None:
            self._timer.cancel()
        self._child.close()

    def _rest(self) -> None:
        """End the child that nobody has asked for a while."""
        if self._lock.acquire(blocking=False):
            try:
                self._child.close()
            finally:
                self._lock.release()

    def _drawn(self, capture: Capture, key: str, request: dict[str, Any]) -> dict[str, Any]:
        """What the child answered to a request, which is kept beside the files that it wrote."""
        place = capture.cache / "views" / key
        with self._lock:
            if not (place / "answer.json").is_file():
                if self._timer is not None:
                    self._timer.cancel()
                place.parent.mkdir(parents=True, exist_ok=True)
                with tempfile.TemporaryDirectory(prefix=".", dir=place.parent) as scratch:
                    found = read_in_child(self._child, {**request, "target": scratch}, SECONDS, f"the asset of {capture.name}")
                    Path(scratch, "answer.json").write_bytes(json.dumps(found).encode())
                    shutil.rmtree(place, ignore_errors=True)
                    shutil.copytree(scratch, place)
                self._timer = threading.Timer(IDLE, self._rest)
                self._timer.daemon = True
                self._timer.start()
            answer: dict[str, Any] = json.loads((place / "answer.json").read_bytes())
            return answer


def _asset_request(task: str, folders: Mapping[str, Path], name: str = "") -> tuple[str, dict[str, Any]]:
    """Key and request of what is drawn of the outputs in these folders."""
    request = {"task": task, "name": name, "folders": {stage: str(folder) for stage, folder in sorted(folders.items())}}
    return blake3(repr(request).encode(errors="backslashreplace")).hexdigest(16), request


class Services:
    """All of them."""

    def __init__(self) -> None:
        self.images, self.checks, self.runs, self.views = Images(), Checks(), Runs(), Views()

    def close(self) -> None:
        """End processes of this server; runs go on."""
        self.images.close()
        self.runs.close()
        self.checks.close()
        self.views.close()
