"""Endpoints of the server: a function of the request that returns a document or a file, run in a thread, its errors as sentences.

JSON is ASCII, as that of the commands: whatever a name holds, it is a string for the page, which shows it as text alone.
"""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from gsbake.errors import BadInputError, GsbakeError, UsageError
from gsbake.studio.services import Services
from gsbake.studio.workspace import Capture, NotFoundError, Workspace
from gsbake.text import printable

#: Largest body of a request in bytes: settings, and the image of a mask.
MAX_JSON, MAX_IMAGE = 1_000_000, 40_000_000
#: Codes of refusals.
CODES: Mapping[type[GsbakeError], int] = {NotFoundError: 404, UsageError: 400, BadInputError: 422}
#: Header of what never changes under its address.
FOREVER = {"Cache-Control": "private, max-age=31536000, immutable"}


@dataclass(frozen=True)
class Call:
    """A request: the captures, what the server keeps while it runs, the names in the address, its query, and the body."""

    workspace: Workspace
    services: Services
    path: Mapping[str, str]
    query: Mapping[str, str]
    body: Any = None

    @property
    def capture(self) -> Capture:
        """The capture that the address names. Raises NotFoundError."""
        return self.workspace.capture(self.path["capture"])

    def number(self, name: str, lowest: int, highest: int, usual: int) -> int:
        """A whole number of the query within bounds."""
        try:
            return min(max(int(self.query.get(name, usual)), lowest), highest)
        except ValueError:
            return usual

    def field(self, name: str, kind: type[Any]) -> Any:
        """A field of the JSON body. Raises UsageError where it is missing or of another kind."""
        value = self.body.get(name) if isinstance(self.body, dict) else None
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise UsageError(f"The request lacks '{name}'.")
        return value


Work = Callable[[Call], Any]


def document(content: Any, code: int = 200) -> Response:
    """A JSON answer."""
    return Response(json.dumps(content, separators=(",", ":")), code, media_type="application/json")


def refusal(error: GsbakeError) -> Response:
    """An error as JSON, with the code of its kind."""
    return document({"error": str(error)}, next((code for kind, code in CODES.items() if isinstance(error, kind)), 409))


def endpoint(work: Work, limit: int = 0, *, raw: bool = False) -> Callable[[Request], Awaitable[Response]]:
    """The endpoint of `work`; with `limit` it takes a body of at most so many bytes, JSON unless `raw`."""

    async def answer(request: Request) -> Response:
        state = request.app.state
        try:
            body = await _body(request, limit) if limit else None
            what = body if raw or body is None else _parsed(body)
            found = await run_in_threadpool(work, Call(state.workspace, state.services, request.path_params, request.query_params, what))
        except GsbakeError as error:
            return refusal(error)
        except ClientDisconnect:
            return Response(status_code=400)
        except OSError as error:
            return refusal(BadInputError(f"A file cannot be read or written ({error.strerror or error})."))
        except Exception as error:
            return document({"error": printable(f"Internal error ({type(error).__name__}: {str(error)[:300]}).")}, 500)
        return found if isinstance(found, Response) else document(found)

    return answer


async def _body(request: Request, limit: int) -> bytes:
    parts, total = [], 0
    async for part in request.stream():
        total += len(part)
        if total > limit:
            raise UsageError(f"The request has more than {limit / 1e6:g} MB.")
        parts.append(part)
    return b"".join(parts)


def _parsed(body: bytes) -> Any:
    try:
        return json.loads(body or b"{}")
    except (ValueError, RecursionError):
        raise UsageError("The request is not JSON.") from None
