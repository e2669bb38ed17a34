"""The asset: its files and targets for download, the photos it is compared with, its maps and lights, and what to photograph next."""

from __future__ import annotations

import json
import mimetypes
from contextlib import suppress
from typing import Any

from starlette.responses import FileResponse, Response

from gsbake.config.targets import BUDGETS, FILE_FORMS, GEOMETRY_FORMS, SURFELS, TEXTURE_FORMS, is_target_file
from gsbake.errors import GsbakeError
from gsbake.gltf.frame import read_transforms_json
from gsbake.publish import is_result
from gsbake.studio.answers import Call
from gsbake.studio.outputs import Output, entries, outputs
from gsbake.studio.sessions import session_of
from gsbake.studio.workspace import NotFoundError

#: Stages that a picture of the asset from a photo's camera needs.
RENDERED = ("ingest", "poses", "refine", "bake", "export")
#: Types of files that the page shows; all others are downloads.
TYPES = {".glb": "model/gltf-binary", ".hdr": "image/vnd.radiance", ".html": "text/html; charset=utf-8", ".json": "application/json"}
#: The report keeps its own policy and gets no access to the studio.
REPORT_POLICY = "sandbox allow-scripts allow-downloads; default-src 'unsafe-inline' 'wasm-unsafe-eval' data: blob:"


def overview(call: Call) -> dict[str, Any]:
    """What there is of the asset."""
    capture = call.capture
    found = outputs(capture)
    files = {}
    for path in [*sorted(capture.out.iterdir()), *sorted(capture.out.glob("asset_film*/*"))] if capture.out.is_dir() else ():
        name = path.relative_to(capture.out).as_posix()
        if is_result(name) and path.is_file() and not path.is_symlink():
            stat = path.stat()
            files[name] = {"bytes": stat.st_size, "version": f"{stat.st_mtime_ns:x}", "target": is_target_file(name)}
    asked: tuple[str, ...] = ()
    with suppress(GsbakeError):
        asked = session_of(capture).profile.profile.targets.files
    return {
        "files": files, "targets": list(asked), "budgets": _budgets(), "forms": [TEXTURE_FORMS, GEOMETRY_FORMS, FILE_FORMS],
        "photos": _photos(found), "report": _figures(found), "maps": _maps(found),
        "others": [other.name for other in call.workspace.captures() if other.name != capture.name and (other.out / "asset.glb").is_file()],
    }  # fmt: skip


def file(call: Call) -> Response:
    """A published file: shown by the page, or with `download` saved. Raises NotFoundError for a name that gsbake does not publish."""
    name = call.path["file"]
    if not is_result(name):
        raise NotFoundError("There is no such file.")
    path = call.capture.output(name)
    kind = TYPES.get(path.suffix) or mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    headers = {"Content-Security-Policy": REPORT_POLICY} if path.suffix == ".html" else {}
    saved = "download" in call.query or path.suffix not in TYPES
    return FileResponse(path, media_type=kind, headers=headers, filename=f"{call.capture.name}-{path.name}" if saved else None)


def preview(call: Call) -> Response:
    """A map of the asset as PNG."""
    found = outputs(call.capture)
    name = call.path["map"]
    if name not in _maps(found):
        raise NotFoundError("There is no such map.")
    return FileResponse(found["export"].folder / "previews" / f"{name}.png", media_type="image/png")


def view(call: Call) -> dict[str, Any]:
    """Photo, render and error map from the camera of a photo, drawn once and kept: addresses and figures."""
    found = outputs(call.capture)
    if (name := call.path["photo"]) not in {photo["name"] for photo in _photos(found)}:
        raise NotFoundError("There is no such photo in this run.")
    key, figures = call.services.views.view(call.capture, {stage: found[stage].folder for stage in RENDERED}, name)
    return {"key": key, **figures}


def picture(call: Call) -> Response:
    """A picture that `view` or `light` has drawn."""
    path = call.services.views.file(call.capture, call.path["key"], call.path["file"])
    return FileResponse(path, media_type=TYPES.get(path.suffix, "image/jpeg"), headers={"Cache-Control": "private, max-age=3600"})


def lights(call: Call) -> dict[str, Any]:
    """Environments for the 3D view: the studio and the sunset of the report; light.hdr is a file of the run."""
    return {"key": call.services.views.lights(call.capture), "names": ["studio", "sunset"]}


def places(call: Call) -> dict[str, Any]:
    """Where to photograph what no photo has seen."""
    found = outputs(call.capture)
    if "export" not in found or "bake" not in found:
        return {"places": []}
    return {"places": call.services.views.places(call.capture, {stage: found[stage].folder for stage in ("bake", "export")})}


def _budgets() -> list[dict[str, Any]]:
    rows = [{"name": name, **vars(budget)} for name, budget in BUDGETS.items()]
    return [*rows, {"name": SURFELS, "megabytes": None, "triangles": None, "texture": None, "pixels": None}]


def _photos(found: dict[str, Output]) -> list[dict[str, Any]]:
    """The photos with cameras, with their figures where the report compared them."""
    if any(stage not in found for stage in RENDERED):
        return []
    scored: dict[str, Any] = {}
    with suppress(OSError, ValueError, LookupError):
        body = json.loads((found["report"].folder / "report.json").read_text(encoding="utf-8"))
        scored = {view["name"]: view.get("psnr") for view in body["views"]}
    sources = {entry["source"].rsplit("/", 1)[-1]: entry for entry in entries(found["ingest"])}
    photos = []
    for camera in read_transforms_json(found["export"].folder / "cameras.json"):
        entry = sources.get(camera.name)
        if entry is not None:
            photos.append({"name": entry["name"], "source": entry["source"], "psnr": scored.get(entry["name"])})
    return photos


def _figures(found: dict[str, Output]) -> dict[str, Any]:
    return dict(found["report"].results) if "report" in found else {}


def _maps(found: dict[str, Output]) -> list[str]:
    return [path.stem for path in sorted((found["export"].folder / "previews").glob("*.png"))] if "export" in found else []
