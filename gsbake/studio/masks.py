"""Masks: shown over their photos, the doubtful ones first, drawn on, cut by GrabCut from a stroke, and written as ordinary mask files."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from blake3 import blake3
from numpy.typing import NDArray
from starlette.responses import Response

from gsbake.atomic import write_atomic
from gsbake.capture.masks.matching import match_masks
from gsbake.capture.sources import PHOTO_FOLDERS
from gsbake.errors import BadInputError, GsbakeError, UsageError
from gsbake.imaging.image_process import read_pixels
from gsbake.imaging.png import encode_png, write_png
from gsbake.own_files import SET_ASIDE, set_aside
from gsbake.studio.answers import Call
from gsbake.studio.grab_cut import grab_cut
from gsbake.studio.images import LARGE, Shown
from gsbake.studio.outputs import Output, entries, outputs
from gsbake.studio.sessions import session_of
from gsbake.studio.workspace import Capture, is_inside

Bytes = NDArray[np.uint8]

#: Folder of mask files.
MASKS = "masks"
#: File in the cache with the digests of the masks that the studio wrote.
WRITTEN = "masks.json"
#: Deflate level of masks on their way to the page.
LEVEL = 1


def listing(call: Call) -> dict[str, Any]:
    """The photos with the source of their mask, doubtful ones first."""
    capture = call.capture
    files, found, doubtful = _files(capture), outputs(capture), set()
    by_source = {entry["source"]: entry for entry in entries(found["ingest"])} if "ingest" in found else {}
    if "poses" in found:
        doubtful = set(found["poses"].results.get("doubtful_masks") or ())
    rows = []
    for name, path in capture.photos().items():
        entry = by_source.get(name)
        made = entry is not None and _made(found, entry) is not None
        alpha = entry is not None and entry["mask"] is not None
        source = "file" if name in files else "alpha" if alpha else "made" if made else "none"
        uncertain = entry is not None and entry["name"] in doubtful
        rows.append({"name": name, "version": f"{path.stat().st_mtime_ns:x}", "source": source, "doubtful": uncertain})
    return {"photos": sorted(rows, key=lambda row: not row["doubtful"]), "folder": capture.shown(_folder(capture))}


def read(call: Call) -> Response:
    """The mask of a photo as PNG of the picture's size, white on the object; all black where there is none."""
    capture, name = call.capture, call.path["photo"]
    shown = _shown(call, name)
    if shown.mask is not None:
        return Response(shown.mask.read_bytes(), media_type="image/png")
    found = outputs(capture)
    mask = np.zeros((shown.height, shown.width), np.uint8)
    if "ingest" in found:
        entry = next((entry for entry in entries(found["ingest"]) if entry["source"] == name), None)
        made = None if entry is None else _made(found, entry)
        if made is not None:
            mask = _resized(_plane(read_pixels(made.read_bytes(), f"the mask of {name}"), 0), shown.width, shown.height)
    return Response(encode_png(mask, LEVEL), media_type="image/png")


def write(call: Call) -> dict[str, Any]:
    """Write the PNG of the body as the mask file, at the size of the photo. A file that the studio did not write is set aside."""
    capture, name = call.capture, call.path["photo"]
    shown = _shown(call, name)
    mask = _plane(_received(call.body, shown), 0)
    folder = _folder(capture)
    target = folder / Path(name).with_suffix(".png")
    earlier = _files(capture).get(name)
    written = _written(capture)
    if earlier is not None:
        target = earlier if earlier.suffix.lower() == ".png" else target
        if written.get(str(earlier)) != _digest(earlier):
            set_aside(earlier, capture.folder / SET_ASIDE / MASKS / earlier.relative_to(folder))
    if not is_inside(target.parent, capture.folder):
        raise UsageError(f"The folder '{target.parent}' is a link to another place, where the studio writes nothing.")
    target.parent.mkdir(parents=True, exist_ok=True)
    if _inverted(capture):
        mask = np.asarray(255 - mask, np.uint8)
    write_png(target, _resized(mask, shown.source_width, shown.source_height))
    capture.cache.mkdir(parents=True, exist_ok=True)
    write_atomic(capture.cache / WRITTEN, json.dumps({**written, str(target): _digest(target)}))
    if capture.project is not None:
        session_of(capture).store_settings()  # the next run knows the folder
    return {"file": capture.shown(target)}


def cut(call: Call) -> Response:
    """The mask that follows from strokes: an image of the picture's size whose red is the mask so far, green where a stroke says object,
    blue where it says background. What lies far from the strokes stays as it is."""
    shown = _shown(call, call.path["photo"])
    given = _received(call.body, shown)
    blue, green, red = (_plane(given, channel) > 127 for channel in (0, 1, 2))
    photo: Any = cv2.imread(str(shown.file), cv2.IMREAD_COLOR)
    mask = np.asarray(np.where(red, 255, 0), np.uint8)
    return Response(encode_png(grab_cut(photo, mask, green, blue), LEVEL), media_type="image/png")


def _shown(call: Call, name: str) -> Shown:
    """The photo's picture with its mask file or alpha channel."""
    capture = call.capture
    return call.services.images.picture(capture, name, LARGE, _files(capture).get(name), _inverted(capture))


def _files(capture: Capture) -> dict[str, Path]:
    """Mask files by photo. Links that lead elsewhere are left out."""
    with suppress(BadInputError, OSError):
        folder = capture.sources().masks
        if folder is not None:
            return {name: path for name, path in match_masks(folder, capture.photos()).items() if is_inside(path, folder)}
    return {}


def _folder(capture: Capture) -> Path:
    """The folder of mask files. Raises UsageError for one outside of the capture, which the studio does not write into."""
    sources = capture.sources()
    if sources.masks is not None and not is_inside(sources.masks, capture.folder):
        raise UsageError(f"The masks of {capture.name} lie outside of it, in '{sources.masks}', and are not edited here.")
    home = sources.photos.parent if sources.photos.name in PHOTO_FOLDERS else sources.photos
    return sources.masks or home / MASKS


def _written(capture: Capture) -> dict[str, str]:
    """{mask file: digest} of what the studio wrote."""
    with suppress(OSError, ValueError, RecursionError):
        found = json.loads((capture.cache / WRITTEN).read_bytes())
        if isinstance(found, dict):
            return found
    return {}


def _digest(path: Path) -> str:
    return blake3(path.read_bytes()).hexdigest()


def _inverted(capture: Capture) -> bool:
    with suppress(GsbakeError):
        return session_of(capture).profile.profile.ingest.invert_masks
    return False


def _made(found: dict[str, Output], entry: dict[str, Any]) -> Path | None:
    """The mask that the stages made for a photo: corrected, else guessed."""
    places = []
    if "poses" in found:
        places.append(found["poses"].folder / "photo_masks" / f"{entry['name']}.png")
    if entry.get("guess"):
        places.append(found["ingest"].folder / entry["guess"])
    return next((path for path in places if path.is_file()), None)


def _received(body: bytes, shown: Shown) -> NDArray[Any]:
    """The pixels of an image from the page. Raises BadInputError for one that is none, UsageError for another size than the picture's."""
    pixels = read_pixels(body, "the mask")
    if pixels.shape[:2] != (shown.height, shown.width):
        raise UsageError(f"The mask has {pixels.shape[1]} × {pixels.shape[0]} pixels, its picture {shown.width} × {shown.height}.")
    return pixels


def _plane(pixels: NDArray[Any], channel: int) -> Bytes:
    """One channel of an image, its only one where it is grey."""
    plane = pixels if pixels.ndim == 2 else pixels[..., min(channel, pixels.shape[2] - 1)]
    if plane.dtype != np.uint8:
        raise BadInputError("The mask is no image of 8 bit.")
    return np.ascontiguousarray(plane)


def _resized(mask: Bytes, width: int, height: int) -> Bytes:
    return np.asarray(cv2.resize(mask, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
