"""ingest: the person's photos, masks and poses become upright 8-bit working photos, each measured, with the poses at their size."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbake.pipeline.errors import BadInputError
from gsbake.pipeline.skip import leave_out
from gsbake.pipeline.stage import Context, Stage

if TYPE_CHECKING:
    from gsbake.capture.photos.quality import Quality
    from gsbake.capture.poses.frames import Given, PhotoSize

#: Fastest PNG compression: the files are read many times and kept for a while, not shipped.
_PNG_LEVEL = 1


@dataclass(frozen=True)
class _Read:
    """What is kept of a photo once its working files are written."""

    entry: dict[str, Any]
    size: PhotoSize
    quality: Quality


@dataclass(frozen=True)
class _MaskSource:
    """Where a photo's mask comes from: its mask file, or its own alpha channel when there is none."""

    file: Path | None
    invert: bool


def run(ctx: Context) -> dict[str, Any]:
    """Read, check and reduce all photos; see docs/architecture.md for the files."""
    from gsbake.capture.masks.matching import match_masks
    from gsbake.capture.sources import list_photos

    folder = ctx.inputs["photos"]
    paths = {path.relative_to(folder).as_posix(): path for path in list_photos(folder)}
    names = _names(paths)
    use_masks = ctx.settings.skip.masks != "never"
    masks = match_masks(ctx.inputs["masks"], paths) if use_masks and "masks" in ctx.inputs else {}
    skipped: list[dict[str, str]] = []
    with ctx.part("duplicates"):
        _drop_copies(paths, skipped, ctx)
    with ctx.part("photos"):
        read = _read_all(ctx, paths, names, masks, skipped)
    least = ctx.settings.ingest.min_photos
    if len(read) < least:
        lost = f" ({len(skipped)} of {len(names)} were skipped: {skipped[0]['source']}: {skipped[0]['why']})" if skipped else ""
        raise BadInputError(f"{folder} has {len(read)} usable photos{lost}, but at least {least} are needed; take more around the object.")
    _mark_alike(ctx, read)
    _settle_masks(ctx, read, masks)
    with ctx.part("resolution"):
        _settle_resolution(ctx, read)
    results = _poses(ctx, list(names), read)
    entries = [r.entry for r in read.values()]
    (ctx.out / "photos.json").write_text(json.dumps({"photos": entries, "skipped": skipped}, indent=1))
    blur = sorted(e["blur"] for e in entries)
    return {
        "photos": len(entries),
        "skipped": len(skipped),
        "masks": sum(e["mask"] is not None for e in entries),
        "near_duplicates": sum(e["duplicate_of"] is not None for e in entries),
        "blur_median": blur[len(blur) // 2],
        "megapixels": sum(e["width"] * e["height"] for e in entries) / 1e6,
        **results,
    }


def _names(paths: dict[str, Path]) -> dict[str, str]:
    """Name of each photo: its path without suffix, folders joined by "_"."""
    names: dict[str, str] = {}
    taken: dict[str, str] = {}
    for relative in paths:
        name = relative.rsplit(".", 1)[0].replace("/", "_")
        if name in taken:
            raise BadInputError(f"The photos {taken[name]} and {relative} would both be called {name}; rename or remove one.")
        taken[name] = relative
        names[relative] = name
    return names


def _drop_copies(paths: dict[str, Path], skipped: list[dict[str, str]], ctx: Context) -> None:
    """Take photos whose file is byte for byte that of an earlier one off the list."""
    from blake3 import blake3

    seen: dict[tuple[int, str], str] = {}
    for relative, path in list(paths.items()):
        try:
            key = (path.stat().st_size, blake3(path.read_bytes()).hexdigest())
        except OSError as error:
            skipped.append({"source": relative, "why": f"cannot be read ({error.strerror})"})
            ctx.warn(f"The photo {relative} cannot be read ({error.strerror}) and was skipped.")
            del paths[relative]
            continue
        if key in seen:
            skipped.append({"source": relative, "why": f"same file as {seen[key]}"})
            ctx.warn(f"The photo {relative} is a copy of {seen[key]} and was skipped.")
            del paths[relative]
        else:
            seen[key] = relative


def _read_all(
    ctx: Context, paths: dict[str, Path], names: dict[str, str], masks: dict[str, Path], skipped: list[dict[str, str]]
) -> dict[str, _Read]:
    """Decode, reduce, measure and write all photos, a few at once; broken ones are skipped with a warning."""
    import cv2

    from gsbake.capture.photos.decode import UnreadablePhotoError

    for sub in ("photos", "masks"):
        (ctx.out / sub).mkdir(exist_ok=True)
    cv2.setNumThreads(1)  # the pool below is the parallelism
    read: dict[str, _Read] = {}
    settings = ctx.settings.ingest
    max_size, invert = int(settings.max_size), bool(settings.invert_masks)
    use_masks = ctx.settings.skip.masks != "never"
    with ThreadPoolExecutor(max(1, min(ctx.threads, 8))) as pool:

        def submit(relative: str) -> Future[_Read]:
            mask_of = _MaskSource(masks.get(relative), invert) if use_masks else None
            return pool.submit(_read_one, paths[relative], relative, names[relative], mask_of, ctx.out, max_size)

        try:
            for done, (relative, future) in enumerate(_in_order(submit, list(paths), 2 * max(1, ctx.threads))):
                ctx.progress(done, len(paths), relative)
                try:
                    read[relative] = future.result()
                except UnreadablePhotoError as error:
                    skipped.append({"source": relative, "why": str(error)})
                    ctx.warn(f"The photo {relative} is unreadable or truncated and was skipped ({error}).")
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    ctx.progress(len(paths), len(paths))
    if not any(e.entry["mask"] for e in read.values()):
        (ctx.out / "masks").rmdir()
    return read


def _in_order(submit: Any, items: list[str], ahead: int) -> Iterator[tuple[str, Future[_Read]]]:
    """Submit at most `ahead` items before the first of them is taken: memory stays bounded for any number of photos."""
    waiting: list[tuple[str, Future[_Read]]] = []
    for item in items:
        waiting.append((item, submit(item)))
        if len(waiting) >= ahead:
            yield waiting.pop(0)
    yield from waiting


def _read_one(path: Path, relative: str, name: str, source: _MaskSource | None, out: Path, max_size: int) -> _Read:
    """One photo and its mask (none without a `source`) to working files; runs in a thread."""
    import cv2

    from gsbake.capture.masks.matching import mask_of
    from gsbake.capture.photos.decode import read_photo, to_working
    from gsbake.capture.photos.exif import camera_key, focal_pixels
    from gsbake.capture.photos.quality import measure
    from gsbake.capture.poses.frames import PhotoSize

    photo = read_photo(path)
    mask = None if source is None else mask_of(photo, relative, source.file, source.invert)
    rgb, mask = to_working(photo, mask, max_size)
    height, width = rgb.shape[:2]
    quality = measure(rgb, mask)
    _write_png(out / "photos" / f"{name}.png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    if mask is not None:
        _write_png(out / "masks" / f"{name}.png", mask)
    focal = focal_pixels(photo.tags, photo.width, photo.height)
    entry = {
        "name": name,
        "file": f"photos/{name}.png",
        "mask": None if mask is None else f"masks/{name}.png",
        "width": width,
        "height": height,
        "source": relative,
        "source_width": photo.width,
        "source_height": photo.height,
        "focal_px": None if focal is None else focal * max(width, height) / max(photo.width, photo.height),
        "camera_model": camera_key(photo.tags),
        "blur": quality.blur,
        "exposure": quality.exposure,
        "duplicate_of": None,
    }
    return _Read(entry, PhotoSize(photo.width, photo.height, photo.orientation), quality)


def _write_png(path: Path, image: Any) -> None:
    """Write a PNG; OpenCV says only that it failed, so a full or read-only disk is told by writing the bytes ourselves."""
    import cv2

    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
    if not done:
        raise ValueError(f"{path.name} could not be encoded as PNG")
    path.write_bytes(data.tobytes())


def _mark_alike(ctx: Context, read: dict[str, _Read]) -> None:
    """Mark and report photos that show the same as an earlier one, and those much more blurred than the rest."""
    from gsbake.capture.photos.quality import blurred, near_duplicates

    entries = [r.entry for r in read.values()]
    alike = near_duplicates([r.quality.thumbnail for r in read.values()])
    for entry, earlier in zip(entries, alike, strict=True):
        if earlier is not None:
            entry["duplicate_of"] = entries[earlier]["name"]
    pairs = [f"{e['name']} = {e['duplicate_of']}" for e in entries if e["duplicate_of"]]
    if pairs:
        ctx.warn(f"{len(pairs)} photos show the same as another one ({_some(pairs)}); they are kept but add nothing.")
    soft = blurred([e["blur"] for e in entries])
    if soft:
        ctx.warn(f"{len(soft)} photos are much more blurred than the rest ({_some([entries[i]['name'] for i in soft])}).")


def _settle_masks(ctx: Context, read: dict[str, _Read], masks: dict[str, Path]) -> None:
    """Say how many photos have masks, where they come from, and what that spares. Raises BadInputError where masks are a must."""
    without = [r.entry["name"] for r in read.values() if r.entry["mask"] is None]
    count = len(read) - len(without)
    if without and ctx.settings.skip.masks == "always":
        raise BadInputError(
            f"{len(without)} of {len(read)} photos have no mask ({_some(without)}), but skip.masks is always; "
            "give them masks or set it to auto."
        )
    files = sum(relative in masks for relative in read)
    given = f"{count} of {len(read)} photos have one: {files} mask files, {count - files} alpha channels" if count else "no photo has one"
    evidence = "masks are not read" if ctx.settings.skip.masks == "never" else given
    leave_out(ctx, "masks", count > 0 and not without, evidence, "object told apart by the masks", "object told apart without masks")
    if count and without:
        ctx.warn(f"{len(without)} of {len(read)} photos have no mask ({_some(without)}); masks work best when every photo has one.")


def _settle_resolution(ctx: Context, read: dict[str, _Read]) -> None:
    """Halve the working photos and masks where the photos hold nothing finer."""
    from gsbake.capture.photos.sharpness import finer_than_sharp

    entries = [r.entry for r in read.values()]
    longer = max(max(e["width"], e["height"]) for e in entries)
    holds, evidence = finer_than_sharp([r.quality.loss_at_half for r in read.values()], longer)
    if not leave_out(ctx, "resolution", holds, evidence, f"photos kept at {longer // 2} pixels", f"photos kept at {longer} pixels"):
        return
    for entry in entries:
        _halve(ctx.out, entry)


def _halve(out: Path, entry: dict[str, Any]) -> None:
    """Write a working photo and its mask again at half the size, and put the size right in `entry`."""
    import cv2

    from gsbake.capture.photos.decode import RawPhoto, to_working

    bgr: Any = cv2.imread(str(out / entry["file"]), cv2.IMREAD_COLOR)
    full: Any = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    mask: Any = None if entry["mask"] is None else cv2.imread(str(out / entry["mask"]), cv2.IMREAD_GRAYSCALE)
    before = max(entry["width"], entry["height"])
    rgb, mask = to_working(RawPhoto(full, None, 1, {}), mask, before // 2)
    _write_png(out / entry["file"], cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    if mask is not None:
        _write_png(out / entry["mask"], mask)
    entry["height"], entry["width"] = rgb.shape[:2]
    if entry["focal_px"] is not None:
        entry["focal_px"] *= max(rgb.shape[:2]) / before


def _poses(ctx: Context, listing: list[str], read: dict[str, _Read]) -> dict[str, Any]:
    """Read the poses that came with the photos, at the size of the working photos, and write them."""
    if "poses" not in ctx.inputs:
        return {"poses": "none"}
    from gsbake.capture.poses.given import read_poses
    from gsbake.geometry.cameras import CameraSet
    from gsbake.geometry.ply import write_cloud

    path = ctx.inputs["poses"]
    with ctx.part("poses"):
        given: Given = read_poses(path, listing, {relative: r.size for relative, r in read.items()})
        cameras = []
        for relative, item in read.items():
            if relative in given.cameras:
                camera = given.cameras[relative].scaled(item.entry["width"], item.entry["height"])
                cameras.append(replace(camera, name=item.entry["name"]))
        (ctx.out / "poses").mkdir()
        CameraSet(tuple(cameras)).save(ctx.out / "poses" / "cameras.json")
        if given.points is not None:
            write_cloud(ctx.out / "poses" / "points.ply", given.points, given.colours if given.colours is not None else given.points * 0)
    without = [r.entry["name"] for relative, r in read.items() if relative not in given.cameras]
    if without:
        ctx.warn(f"{len(without)} photos have no pose in {path.name} ({_some(without)}) and will not be used.")
    if given.missing:
        ctx.warn(f"{len(given.missing)} frames of {path.name} have no photo ({_some(list(given.missing))}).")
    ctx.decide("poses", f"given for {len(cameras)} of {len(read)} photos", path.name)
    return {"poses": path.name, "posed": len(cameras), "frames_without_photo": len(given.missing)}


def _some(names: list[str]) -> str:
    """The first few names, and how many more there are."""
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


STAGE = Stage(
    name="ingest",
    version=2,
    title="Read photos",
    run=run,
    sources=("photos", "masks", "poses"),
    settings=("ingest.*", "skip.masks", "skip.resolution"),
)
