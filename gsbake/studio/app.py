"""The addresses of the server."""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from importlib import resources

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import ASGIApp

from gsbake.studio import asset, captures, masks, photos, runs, scene, settings, uploads
from gsbake.studio.answers import MAX_IMAGE, MAX_JSON, endpoint
from gsbake.studio.security import Guard, policy
from gsbake.studio.services import Services
from gsbake.studio.workspace import Workspace

#: Types of the page's own files.
TYPES = {
    ".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}  # fmt: skip
#: The 3D viewer, which the report has too.
VIEWER = "model-viewer.min.js"


@cache
def web_files() -> dict[str, bytes]:
    """{path: content} of the page's own files."""
    folder = resources.files("gsbake.studio").joinpath("web")
    found = {entry.name: entry.read_bytes() for entry in folder.iterdir() if entry.is_file()}
    found["vendor/three.module.min.js"] = folder.joinpath("vendor", "three.module.min.js").read_bytes()
    found[f"vendor/{VIEWER}"] = resources.files("gsbake.report").joinpath("vendor", VIEWER).read_bytes()
    return found


@cache
def page_policy() -> str:
    """The content security policy, with the digests of the style sheets that the 3D viewer puts into the page."""
    styles = re.findall(r"<style>(.*?)</style>", web_files()[f"vendor/{VIEWER}"].decode(), re.DOTALL)
    return policy(f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in styles)


async def page(request: Request) -> Response:
    """A file of the page."""
    name = request.path_params.get("name", "index.html")
    content = web_files().get(name)
    kind = TYPES.get(name[name.rfind(".") :]) if content is not None else None
    if content is None or kind is None:
        return Response(status_code=404)
    return Response(content, media_type=kind, headers={"Cache-Control": "private, max-age=3600"} if name.startswith("vendor/") else None)


def routes() -> list[Route]:
    """All addresses."""
    one = "/api/captures/{capture}"
    return [
        Route("/", page),
        Route("/web/{name:path}", page),
        Route("/api/settings", endpoint(settings.form)),
        Route("/api/captures", endpoint(captures.listing), methods=["GET"]),
        Route("/api/captures", endpoint(captures.create, MAX_JSON), methods=["POST"]),
        Route(one, endpoint(captures.details)),
        Route(f"{one}/thumbnail", endpoint(captures.thumbnail)),
        Route(f"{one}/upload/{{file}}", endpoint(uploads.received), methods=["GET"]),
        Route(f"{one}/upload/{{file}}", uploads.receive, methods=["PUT"]),
        Route(f"{one}/photos", endpoint(photos.listing)),
        Route(f"{one}/photos/{{photo:path}}", endpoint(photos.image)),
        Route(f"{one}/check", endpoint(photos.check, MAX_JSON), methods=["POST"]),
        Route(f"{one}/settings", endpoint(settings.stored), methods=["GET"]),
        Route(f"{one}/settings", endpoint(settings.change, MAX_JSON), methods=["POST"]),
        Route(f"{one}/masks", endpoint(masks.listing)),
        Route(f"{one}/masks/{{photo:path}}", endpoint(masks.read), methods=["GET"]),
        Route(f"{one}/masks/{{photo:path}}", endpoint(masks.write, MAX_IMAGE, raw=True), methods=["PUT"]),
        Route(f"{one}/masks/{{photo:path}}", endpoint(masks.cut, MAX_IMAGE, raw=True), methods=["POST"]),
        Route(f"{one}/scene", endpoint(scene.scene)),
        Route(f"{one}/scene/points", endpoint(scene.points)),
        Route(f"{one}/scene/epipolar", endpoint(scene.epipolar, MAX_JSON), methods=["POST"]),
        Route(f"{one}/plan", endpoint(runs.plan, MAX_JSON), methods=["POST"]),
        Route(f"{one}/run", endpoint(runs.state), methods=["GET"]),
        Route(f"{one}/run", endpoint(runs.start, MAX_JSON), methods=["POST"]),
        Route(f"{one}/run", endpoint(runs.stop, MAX_JSON), methods=["DELETE"]),
        Route(f"{one}/picture", endpoint(runs.picture)),
        Route(f"{one}/asset", endpoint(asset.overview)),
        Route(f"{one}/asset/lights", endpoint(asset.lights)),
        Route(f"{one}/asset/places", endpoint(asset.places)),
        Route(f"{one}/asset/maps/{{map}}", endpoint(asset.preview)),
        Route(f"{one}/asset/views/{{photo}}", endpoint(asset.view)),
        Route(f"{one}/asset/pictures/{{key}}/{{file}}", endpoint(asset.picture)),
        Route(f"{one}/files/{{file:path}}", endpoint(asset.file)),
    ]


def guarded_app(workspace: Workspace, services: Services, token: str, port: int) -> ASGIApp:
    """The application behind its guard."""
    app = Starlette(routes=routes())
    app.state.workspace, app.state.services = workspace, services
    return Guard(app, token, port, page_policy())
