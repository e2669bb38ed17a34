from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from gsbake.capture.photos.quality import blur_effect, find_blurred, find_near_duplicates
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import CameraSet
from tests.capture.conftest import Runner, picture


def photos(folder: Path, count: int = 4, suffix: str = "png") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        Image.fromarray(picture(i)).save(folder / f"p{i}.{suffix}")
    return folder


def listing(runner: Runner) -> dict[str, Any]:
    return dict(json.loads((runner.root / "ingest" / "photos.json").read_text()))


def test_plain_photos(tmp_path: Path, runner: Runner) -> None:
    results, done = runner.ingest(photos(tmp_path / "images"), max_size=32)
    assert results["photos"] == 4 and results["masks"] == 0 and results["poses"] == "none" and not done.warnings
    entry = listing(runner)["photos"][1]
    assert (entry["name"], entry["width"], entry["height"], entry["source_width"], entry["mask"]) == ("p1", 32, 24, 64, None)
    assert cv2.imread(str(done.out / entry["file"])).shape == (24, 32, 3)
    assert not (done.out / "masks").exists() and not (done.out / "poses").exists()


def test_exposure_is_log2_of_luminance(tmp_path: Path, runner: Runner) -> None:
    folder = photos(tmp_path / "images")
    Image.fromarray(np.full((48, 64, 3), 188, np.uint8)).save(folder / "half.png")
    runner.ingest(folder)
    entry = next(e for e in listing(runner)["photos"] if e["name"] == "half")
    assert entry["exposure"] == pytest.approx(-0.99, abs=0.01)  # 188 is 0.503 of full light


def test_two_photos_are_too_few(tmp_path: Path, runner: Runner) -> None:
    with pytest.raises(BadInputError, match="2 usable photos"):
        runner.ingest(photos(tmp_path / "images", 2))


def test_photos_are_left_out_by_path_or_file_name(tmp_path: Path, runner: Runner) -> None:
    folder = photos(tmp_path / "images", 6)
    photos(folder / "side", 2, "jpg")
    results, _ = runner.ingest(folder, settings={"leave_out": ("p4.png", "side/p0.jpg", "p1.jpg")})
    assert results["photos"] == 5
    assert [s["source"] for s in listing(runner)["skipped"]] == ["p4.png", "side/p0.jpg", "side/p1.jpg"]


@pytest.mark.parametrize("name, problem", [("p9.png", "none"), ("p0.jpg", "2")])
def test_a_photo_that_is_left_out_is_one_of_them(name: str, problem: str, tmp_path: Path, runner: Runner) -> None:
    for folder in ("images", "images/side", "images/above"):
        photos(tmp_path / folder, 2, "jpg" if folder != "images" else "png")
    with pytest.raises(BadInputError, match=f"leave_out names '{name}', which is {problem} of the photos"):
        runner.ingest(tmp_path / "images", settings={"leave_out": (name,)})


def test_truncated_jpeg_is_skipped(tmp_path: Path, runner: Runner) -> None:
    folder = photos(tmp_path / "images", 4, "jpg")
    data = (folder / "p2.jpg").read_bytes()
    (folder / "p2.jpg").write_bytes(data[: len(data) * 2 // 3])
    results, done = runner.ingest(folder)
    assert results["photos"] == 3 and results["skipped"] == 1
    assert any("p2.jpg" in w and "skipped" in w for w in done.warnings)
    assert [s["source"] for s in listing(runner)["skipped"]] == ["p2.jpg"]


def test_identical_files_and_near_duplicates(tmp_path: Path, runner: Runner) -> None:
    folder = photos(tmp_path / "images", 4)
    (folder / "copy.png").write_bytes((folder / "p0.png").read_bytes())
    Image.fromarray(picture(1)).save(folder / "again.jpg", quality=97)
    results, done = runner.ingest(folder)
    assert results["photos"] == 5 and results["skipped"] == 1 and results["near_duplicates"] == 1
    assert {e["name"]: e["duplicate_of"] for e in listing(runner)["photos"]}["p1"] == "again"
    assert any("copy" in w for w in done.warnings) and any("p1 = again" in w for w in done.warnings)


def test_alpha_becomes_mask(tmp_path: Path, runner: Runner) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(3):
        rgba = np.dstack([picture(i), np.zeros((48, 64), np.uint8)])
        rgba[10:30, 10:30, 3] = 255
        Image.fromarray(rgba).save(folder / f"p{i}.png")
    results, done = runner.ingest(folder)
    assert results["masks"] == 3 and "3 alpha channels" in done.line("masks")
    mask = cv2.imread(str(done.out / "masks" / "p1.png"), cv2.IMREAD_GRAYSCALE)
    assert mask is not None and mask[20, 20] == 255 and mask[5, 5] == 0 and int((mask == 255).sum()) == 400
    assert (cv2.imread(str(done.out / "photos" / "p1.png"))[47, 63] == 0).all()


def test_mask_files_of_both_names_and_inversion(tmp_path: Path, runner: Runner) -> None:
    folder, masks = photos(tmp_path / "images"), tmp_path / "masks"
    masks.mkdir()
    mask = np.zeros((48, 64), np.uint8)
    mask[:, :16] = 255
    Image.fromarray(mask).save(masks / "p0.png")
    Image.fromarray(mask).save(masks / "p1.png.png")
    results, done = runner.ingest(tmp_path, invert_masks=True)
    assert results["masks"] == 2
    assert any("2 of 4 photos have no mask" in w for w in done.warnings)
    for name in ("p0", "p1"):
        written = cv2.imread(str(done.out / "masks" / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        assert written is not None and (written == 255 - mask).all()
    assert folder.is_dir()


def test_mask_for_no_photo(tmp_path: Path, runner: Runner) -> None:
    photos(tmp_path / "images")
    (tmp_path / "masks").mkdir()
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(tmp_path / "masks" / "other.png")
    with pytest.raises(BadInputError, match=r"no photo belongs to other\.png"):
        runner.ingest(tmp_path)


def test_mask_of_another_size(tmp_path: Path, runner: Runner) -> None:
    photos(tmp_path / "images")
    (tmp_path / "masks").mkdir()
    Image.fromarray(np.zeros((50, 64), np.uint8)).save(tmp_path / "masks" / "p3.png")
    with pytest.raises(BadInputError, match=r"64x50.*p3\.png has 64x48"):
        runner.ingest(tmp_path)


def test_mask_of_the_stored_photo_is_rotated_with_it(tmp_path: Path, runner: Runner) -> None:
    folder, masks = photos(tmp_path / "images", 3), tmp_path / "masks"
    masks.mkdir()
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(picture(9)).save(folder / "turned.jpg", exif=exif)
    mask = np.zeros((48, 64), np.uint8)
    mask[:, :8] = 255  # left edge as stored comes to the top
    Image.fromarray(mask).save(masks / "turned.png")
    _, done = runner.ingest(tmp_path)
    written = cv2.imread(str(done.out / "masks" / "turned.png"), cv2.IMREAD_GRAYSCALE)
    assert written is not None and written.shape == (64, 48) and written[:8].min() == 255 and written[8:].max() == 0


def test_whether_a_flash_fired(tmp_path: Path, runner: Runner) -> None:
    """Bit 0 of the tag says so; the others tell how it was set."""
    folder = photos(tmp_path / "images", 3)
    for name, value in (("fired", 0x19), ("off", 0x10), ("auto", 0)):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x9209] = value
        Image.fromarray(picture(value)).save(folder / f"{name}.jpg", exif=exif)
    _, done = runner.ingest(tmp_path)
    found = {e["name"]: e["flash"] for e in json.loads((done.out / "photos.json").read_text(encoding="utf-8"))["photos"]}
    assert found == {"fired": True, "off": False, "auto": False, "p0": None, "p1": None, "p2": None}


def test_the_exposure_by_exif(tmp_path: Path, runner: Runner) -> None:
    """1/50 s at f/4 and ISO 200 is as bright as 1/100 s at f/2 and ISO 100; without one of the three it is not known."""
    folder = photos(tmp_path / "images", 3)
    for k, (time, aperture, speed) in enumerate(((50, 4, 200), (100, 2, 100), (100, 2, None))):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829A: IFDRational(1, time), 0x829D: IFDRational(aperture, 1)} | ({0x8827: speed} if speed else {}))
        Image.fromarray(picture(20 + k)).save(folder / f"e{k}.jpg", exif=exif)
    _, done = runner.ingest(tmp_path)
    found = {e["name"]: e["light_exposure"] for e in json.loads((done.out / "photos.json").read_text(encoding="utf-8"))["photos"]}
    assert found["e0"] == pytest.approx(0.25) and found["e1"] == pytest.approx(0.25) and found["e2"] is None and found["p0"] is None


def test_photos_of_equal_names(tmp_path: Path, runner: Runner) -> None:
    folder = photos(tmp_path / "images")
    Image.fromarray(picture(7)).save(folder / "p0.jpg")
    with pytest.raises(BadInputError, match="p0"):
        runner.ingest(folder)


def transforms(path: Path, count: int, **extra: Any) -> dict[str, Any]:
    frames = []
    for i in range(count):
        matrix = np.eye(4)
        matrix[:3, 3] = (0.1 * i, 0.0, 3.0)
        frames.append({"file_path": f"images/p{i}.png", "transform_matrix": matrix.tolist()})
    body = {"fl_x": 80.0, "fl_y": 80.0, "cx": 30.0, "cy": 25.0, "w": 64, "h": 48, "frames": frames, **extra}
    path.write_text(json.dumps(body))
    return body


def test_a_frame_of_a_photo_that_is_left_out_lacks_none(tmp_path: Path, runner: Runner) -> None:
    photos(tmp_path / "images")
    transforms(tmp_path / "transforms.json", 4)
    results, done = runner.ingest(tmp_path, settings={"leave_out": ("p1.png",)})
    assert results["posed"] == 3 and results["frames_without_photo"] == 0
    assert not [w for w in done.warnings if "have no photo" in w]


def test_poses_at_the_working_size(tmp_path: Path, runner: Runner) -> None:
    photos(tmp_path / "images")
    transforms(tmp_path / "transforms.json", 5)
    results, done = runner.ingest(tmp_path, max_size=32)
    assert results["posed"] == 4 and results["frames_without_photo"] == 1
    assert any("1 frames" in w for w in done.warnings)
    camera = CameraSet.load(done.out / "poses" / "cameras.json").cameras[2]
    assert (camera.name, camera.width, camera.height, camera.fx, camera.cx, camera.cy) == ("p2", 32, 24, 40.0, 15.0, 12.5)
    assert camera.centre == pytest.approx([0.2, 0, 3]) and camera.view_direction == pytest.approx([0, 0, -1])


def test_nan_in_a_pose_names_the_frame(tmp_path: Path, runner: Runner) -> None:
    photos(tmp_path / "images")
    body = transforms(tmp_path / "transforms.json", 4)
    body["frames"][2]["transform_matrix"][1][3] = float("nan")
    (tmp_path / "transforms.json").write_text(json.dumps(body))
    with pytest.raises(BadInputError, match=r"Frame 3: .*finite number"):
        runner.ingest(tmp_path)


def test_blur_effect_rises_with_blur() -> None:
    sharp = np.random.default_rng(0).integers(0, 255, (200, 200)).astype(np.float32)
    figures = [blur_effect(cv2.GaussianBlur(sharp, (0, 0), s) if s else sharp) for s in (0, 1, 2, 4)]
    assert figures == sorted(figures) and figures[0] < 0.3 and figures[-1] > 0.7
    assert find_blurred([0.2, 0.21, 0.2, 0.22, 0.6, 0.2]) == [4] and find_blurred([0.2, 0.2]) == []


def test_near_duplicates_point_to_the_first() -> None:
    one = np.full((32, 32), 100, np.float32)
    assert find_near_duplicates([one, one + 30, one + 0.5, one + 0.9, one + 29.6]) == [None, None, 0, 0, 1]
