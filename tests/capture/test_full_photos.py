"""Photos at full size against the working photos of the same capture."""

from __future__ import annotations

import io
import json
import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from gsbake.capture import full_photos
from gsbake.capture.full_photos import FullPhotos
from gsbake.capture.photos.originals import Originals
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.imaging.png import read_grey, write_png
from gsbake.imaging.srgb import decode_bytes, encode_bytes
from tests.capture.conftest import Runner
from tests.support.cameras import look_at
from tests.support.dng import write_dng

Pixels = np.ndarray[Any, np.dtype[np.uint8]]
FULL, WORKING, SMALL = (400, 300), 160, 48
LENS = {"k1": -0.08, "k2": 0.02, "p1": 0.002, "p2": -0.003}


def picture(seed: int, size: tuple[int, int] = FULL) -> Pixels:
    """A photo with detail at several scales, whose edges a shift of half a pixel changes by many grey levels."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.random((cells * 3, cells * 4, 3)), size, interpolation=cv2.INTER_CUBIC) for cells in (3, 9, 27)]
    return np.asarray(np.clip(80 * sum(layers), 0, 255), np.uint8)


def mask(size: tuple[int, int] = FULL) -> Pixels:
    shape = np.zeros((size[1], size[0]), np.uint8)
    cv2.circle(shape, (size[0] // 2, size[1] // 2), size[1] // 3, 255, -1)
    return shape


def cameras(size: tuple[int, int] = FULL, count: int = 4) -> list[Camera]:
    angles = np.radians(np.linspace(-30, 30, count))
    eyes = [np.array([3 * np.sin(a), -1.0, 3 * np.cos(a)]) for a in angles]
    return [look_at(eye, size=size, focal=1.2 * size[0], name=f"p{i}", up=(0.0, 1.0, 0.0)) for i, eye in enumerate(eyes)]


def capture(folder: Path, suffix: str = "png", lens: dict[str, float] | None = None, masks: bool = True) -> None:
    """Four photos with known poses, and masks."""
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    frames = []
    for k, camera in enumerate(cameras()):
        Image.fromarray(picture(k)).save(folder / "images" / f"p{k}.{suffix}")
        if masks:
            write_png(folder / "masks" / f"p{k}.png", mask())
        frames.append({"file_path": f"images/p{k}.{suffix}", "transform_matrix": camera.camera_to_world_opengl().tolist()})
    focal = 1.2 * FULL[0]
    body = {"fl_x": focal, "cx": 205.0, "cy": 148.0, "w": FULL[0], "h": FULL[1], "frames": frames} | (LENS if lens is None else lens)
    (folder / "transforms.json").write_text(json.dumps(body))


def prepared(folder: Path, runner: Runner, **more: Any) -> tuple[Path, Path]:
    """Folders of the ingest and the poses stage."""
    settings = {"max_size": WORKING} | more
    _, ingested = runner.ingest(folder, resolution="keep", **settings)
    _, posed = runner.poses(redundant_photos="keep")
    return ingested.out, posed.out


def reduced(rgb: Pixels, size: tuple[int, int]) -> Pixels:
    return encode_bytes(cv2.resize(decode_bytes(rgb), size, interpolation=cv2.INTER_AREA))


def test_undistortion_at_full_size_agrees_with_the_working_photo(tmp_path: Path, runner: Runner) -> None:
    capture(tmp_path)
    with FullPhotos(*prepared(tmp_path, runner)) as photos:
        for k in range(len(photos)):
            view, working = photos.view(k), photos.posed.view(k)
            assert (view.camera.width, view.camera.height) == view.rgb.shape[1::-1] and max(view.rgb.shape) > 2 * max(working.rgb.shape[:2])
            size = working.camera.width, working.camera.height
            margin = (slice(2, -2), slice(2, -2))
            difference = np.abs(reduced(view.rgb, size).astype(int) - working.rgb)[margin]
            shifted = np.abs(np.roll(reduced(view.rgb, size), 1, 1).astype(int) - working.rgb)[margin]
            assert difference.mean() < 1.5 < 0.25 * shifted.mean()  # half a pixel of shift makes half of what a whole one makes
            # The same ray meets the same place of both photos.
            rays = (view.camera.rays()[[0, -1], [0, -1]], working.camera.rays()[[0, -1], [0, -1]])
            pixel = 0.5 / view.camera.fx + 0.5 / working.camera.fx
            assert np.abs(rays[0] - rays[1]).max() < pixel
            assert view.mask is not None and working.mask is not None and set(np.unique(view.mask)) >= {0, 255}
            both = cv2.resize(view.mask, size, interpolation=cv2.INTER_AREA).astype(int) - working.mask
            assert np.abs(both).mean() < 1.0
            assert ((view.mask > 10) & (view.mask < 245)).mean() < 0.02  # sharper than an enlarged one


def test_exposures_by_exif_are_those_of_the_cameras_in_order(tmp_path: Path, runner: Runner) -> None:
    """Folders of before the field was written, and photos of which one has none, have no exposures."""
    capture(tmp_path, "jpg")
    for k, time in enumerate((50, 100, 200, 100)):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829A: IFDRational(1, time), 0x829D: IFDRational(4, 1), 0x8827: 200})
        Image.fromarray(picture(k)).save(tmp_path / "images" / f"p{k}.jpg", exif=exif)
    ingest, poses = prepared(tmp_path, runner)
    with FullPhotos(ingest, poses) as photos:
        expected = {"p0": np.log(2), "p1": 0.0, "p2": -np.log(2), "p3": 0.0}
        assert photos.written_exposures() == pytest.approx([expected[c.name] for c in photos.posed.cameras.cameras], abs=1e-6)
    with FullPhotos(None, poses) as photos:
        assert photos.written_exposures() is None
    listing = json.loads((ingest / "photos.json").read_text(encoding="utf-8"))
    for kept in (3, 0):
        for entry in listing["photos"][kept:]:
            entry.pop("light_exposure", None)
        (ingest / "photos.json").write_text(json.dumps(listing), encoding="utf-8")
        with FullPhotos(ingest, poses) as photos:
            assert photos.written_exposures() is None


def test_a_level_in_between(tmp_path: Path, runner: Runner) -> None:
    capture(tmp_path)
    with FullPhotos(*prepared(tmp_path, runner)) as photos:
        full, level = photos.view(1), photos.view(1, 250)
        assert max(level.rgb.shape) == 250 and level.camera.width == level.rgb.shape[1] and level.camera == photos.camera(1, 250)
        assert np.abs(reduced(full.rgb, level.rgb.shape[1::-1]).astype(int) - level.rgb).mean() < 1.5
        assert level.mask is not None and level.mask.shape == level.rgb.shape[:2]
        assert (photos.view(1, 100).rgb == photos.posed.view(1, 100).rgb).all()


def test_a_share_of_the_full_size_within_the_pixels_of_all_photos(tmp_path: Path, runner: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    capture(tmp_path)
    with FullPhotos(*prepared(tmp_path, runner)) as photos:
        full = max(photos.camera(0).width, photos.camera(0).height)
        assert photos.size_of(50, 0.5) == round(0.5 * full) and photos.size_of(300, 0.5) == 300
        monkeypatch.setattr(full_photos, "MAX_TOTAL_PIXELS", 20_000 * len(photos))
        limited = photos.size_of(50, 0.5)
        reduced_cameras = [photos.camera(k, limited) for k in range(len(photos))]
        assert 0.95 < sum(c.width * c.height for c in reduced_cameras) / (20_000 * len(photos)) < 1.05
        assert photos.size_of(300, 0.5) == 300


def test_a_photo_without_distortion_is_the_original_itself(tmp_path: Path, runner: Runner) -> None:
    capture(tmp_path, lens={})
    with FullPhotos(*prepared(tmp_path, runner)) as photos:
        view = photos.view(2)
    assert (view.rgb == picture(2)).all() and view.mask is not None and (view.mask == mask()).all()
    assert view.camera.fx == pytest.approx(1.2 * FULL[0]) and (view.camera.cx, view.camera.cy) == pytest.approx((205, 148))


def test_cameras_that_training_refined(tmp_path: Path, runner: Runner) -> None:
    capture(tmp_path)
    ingested, poses = prepared(tmp_path, runner)
    known = CameraSet.load(poses / "cameras.json")
    (tmp_path / "refine").mkdir()
    moved = tuple(replace(c, t=c.t + 0.01, fx=1.01 * c.fx) for c in known.cameras)
    replace(known, cameras=moved).save(tmp_path / "refine" / "cameras.json")
    with FullPhotos(ingested, poses) as before, FullPhotos(ingested, poses, tmp_path / "refine") as after:
        one, other = before.view(0), after.view(0)
    assert (one.rgb == other.rgb).all() and other.camera.fx == pytest.approx(1.01 * one.camera.fx) and (other.camera.t == moved[0].t).all()


def turned(seed: int) -> bytes:
    """A JPEG that EXIF turns: stored in landscape, shown in portrait."""
    exif, file = Image.Exif(), io.BytesIO()
    exif[0x0112] = 6
    Image.fromarray(picture(seed)).save(file, "JPEG", quality=95, exif=exif)
    return file.getvalue()


def test_originals_of_every_kind(tmp_path: Path, runner: Runner) -> None:
    """Turned by EXIF, undeveloped, with alpha as the mask, of a telephone, and one no larger than the working size."""
    folder = tmp_path / "images"
    folder.mkdir()
    (folder / "turned.jpg").write_bytes(turned(1))
    Image.fromarray(np.dstack([picture(2), mask()])).save(folder / "alpha.png")
    Image.fromarray(picture(3, (40, 30))).save(folder / "small.png")
    shutil.copy(Path(__file__).parent / "photos/telephone.heic", folder / "telephone.heic")
    write_dng(folder / "raw.dng", decode_bytes(picture(4)).astype(np.float64))
    runner.ingest(folder, max_size=SMALL, resolution="keep")
    listed = {e["name"]: e for e in json.loads((runner.root / "ingest/photos.json").read_text())["photos"]}
    with closing(Originals(runner.root / "ingest")) as originals:
        assert originals.size("turned") == (300, 400) and originals.read("turned").shape == (400, 300, 3)
        upright = np.rot90(picture(1), -1)
        assert np.abs(originals.read("turned").astype(int) - upright).mean() < 8
        assert np.abs(originals.read("turned", 200).astype(int) - reduced(upright, (150, 200))).mean() < 4
        alpha = originals.mask("alpha", FULL)
        assert alpha is not None and (alpha == mask()).all() and (originals.read("alpha")[mask() > 0] == picture(2)[mask() > 0]).all()
        assert not originals.has("small") and listed["small"]["original"] is listed["small"]["full_mask"] is None
        assert originals.read("telephone").shape == (64, 48, 3) and originals.read("raw").shape == (300, 400, 3)
        assert np.abs(originals.read("raw").astype(int) - picture(4)).mean() < 8  # developed from a mosaic
    kept = {name: entry["original"] for name, entry in listed.items() if entry["original"]}
    suffixes = {"turned": "jpg", "alpha": "png", "telephone": "heic", "raw": "png"}
    assert kept == {name: f"originals/{name}.{suffix}" for name, suffix in suffixes.items()}


def test_an_artifact_that_moved_without_its_photos(tmp_path: Path, runner: Runner) -> None:
    capture(tmp_path / "capture", "jpg")
    ingested, poses = prepared(tmp_path / "capture", runner)
    with FullPhotos(ingested, poses) as photos:
        before = photos.view(3).rgb
    shutil.rmtree(tmp_path / "capture")
    shutil.move(ingested, tmp_path / "elsewhere")
    with FullPhotos(tmp_path / "elsewhere", poses) as photos:
        assert (photos.view(3).rgb == before).all()


def test_what_was_replaced_by_hand_counts(tmp_path: Path, runner: Runner) -> None:
    capture(tmp_path)
    ingested, poses = prepared(tmp_path, runner)
    write_png(poses / "photos/p0.png", 255 - PosedPhotos.open(poses).view(0).rgb)
    write_png(ingested / "photos/p1.png", picture(9, (160, 120)))
    edited = read_grey(poses / "masks/p2.png")
    edited[:, : edited.shape[1] // 2] = 0
    write_png(poses / "masks/p2.png", edited)
    with FullPhotos(ingested, poses) as photos:
        for k in (0, 1):
            assert (photos.view(k).rgb == photos.posed.view(k).rgb).all()
        view = photos.view(2)
        assert view.mask is not None and view.rgb.shape[1] > 300
        half = view.mask.shape[1] // 2
        assert view.mask[:, : half - 3].max() == 0 and view.mask[:, half + 3 :].max() == 255
    known = CameraSet.load(poses / "cameras.json")
    moved = tuple(replace(c, fx=1.1 * c.fx, fy=1.1 * c.fy, t=c.t + 0.1) for c in known.cameras)
    with FullPhotos(ingested, poses) as photos:
        before = photos.view(2)
    replace(known, cameras=moved).save(poses / "cameras.json")  # the photos are as they were
    with FullPhotos(ingested, poses) as photos:
        after = photos.view(2)
    assert (after.rgb == before.rgb).all() and after.camera.fx == pytest.approx(1.1 * before.camera.fx)
    (poses / "photo_cameras.json").unlink()
    with FullPhotos(ingested, poses) as photos:
        assert (photos.view(2).rgb == photos.posed.view(2).rgb).all() and photos.camera(2) == photos.posed.cameras.cameras[2]


def test_an_original_that_cannot_be_read_is_named(tmp_path: Path, runner: Runner) -> None:
    capture(tmp_path, "jpg")
    ingested, poses = prepared(tmp_path, runner)
    (ingested / "originals/p1.jpg").unlink()
    (ingested / "originals/p1.jpg").write_bytes(b"nothing")
    refused = r"The original of p1\.jpg cannot be read \(.*run `gsbake ingest` again"
    with FullPhotos(ingested, poses) as photos, pytest.raises(BadInputError, match=refused):
        photos.view(1)


def test_oversampled_photos_are_not_kept(tmp_path: Path, runner: Runner) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for k in range(3):
        blurred = cv2.resize(picture(k, (150, 110)), (1600, 1200), interpolation=cv2.INTER_CUBIC)
        Image.fromarray(blurred).save(folder / f"p{k}.png")
    runner.ingest(folder, max_size=1200)
    entries = json.loads((runner.root / "ingest/photos.json").read_text())["photos"]
    assert entries[0]["width"] == 600 and entries[0]["original"] is None and not (runner.root / "ingest/originals").exists()
