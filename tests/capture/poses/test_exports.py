"""What ordinary programs write: matrices with a scale, masks and depths of frames, equal names in folders, upper-case suffixes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from gsbake.capture.sources import discover
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet
from tests.capture.conftest import Runner, picture
from tests.support.cameras import look_at

#: Photos of two rounds, which have equal names, by their paths inside `images/`.
FILES = ("front/000001.JPG", "front/000002.JPG", "back/000001.JPG", "back/000002.JPG")


def cameras() -> list[Camera]:
    """A camera for each of FILES, with its own focal length."""
    eyes = ((3, 0, 1), (0, 3, 1), (-3, 0, 1), (0, -3, 1))
    return [look_at(np.array(eye, float), size=(64, 48), focal=70.0 + k, name=FILES[k]) for k, eye in enumerate(eyes)]


def frame(camera: Camera, **more: Any) -> dict[str, Any]:
    inner = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": camera.width, "h": camera.height}
    return {"file_path": f"./images/{camera.name}", "transform_matrix": camera.camera_to_world_opengl().tolist(), **inner, **more}


def capture(root: Path, frames: list[dict[str, Any]]) -> Path:
    for k, name in enumerate(FILES):
        (root / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture(k)).save(root / "images" / name, "JPEG")
    (root / "transforms.json").write_text(json.dumps({"frames": frames}), encoding="utf-8")
    return root


def mask(column: int) -> NDArray[np.uint8]:
    """A mask that is white left of a column."""
    out = np.zeros((48, 64), np.uint8)
    out[:, :column] = 255
    return out


def write_masks(root: Path, names: list[str]) -> list[str]:
    """The k-th mask is white left of column 10 + k."""
    for k, name in enumerate(names):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask(10 + k)).save(root / name, "PNG")
    return names


def scaled(entry: dict[str, Any], factors: tuple[float, float, float]) -> dict[str, Any]:
    matrix = np.array(entry["transform_matrix"])
    matrix[:3, :3] *= factors
    return entry | {"transform_matrix": matrix.tolist()}


def test_a_scale_of_all_matrices_is_divided_out(tmp_path: Path, runner: Runner) -> None:
    """Positions stay: a scale of the axes moves no ray."""
    capture(tmp_path, [scaled(frame(camera), (2.5, 2.5, 2.5)) for camera in cameras()])
    _, done = runner.ingest(tmp_path)
    assert done.line("scale of the matrices") == "divided out (4 of 4 in transforms.json carry a scale of 2.5)"
    found = {c.name: c for c in CameraSet.load(done.out / "poses" / "cameras.json").cameras}
    for camera in cameras():
        read = found[camera.name.replace("/", "_").removesuffix(".JPG")]
        assert np.allclose(read.R, camera.R) and np.allclose(read.centre, camera.centre)


@pytest.mark.parametrize("factors", [(2.0, 2.0, 2.2), (-2.0, 2.0, 2.0), (1e-9, 1e-9, 1e-9), (0.0, 0.0, 0.0)])
def test_shear_mirrors_and_nothing_are_refused(tmp_path: Path, runner: Runner, factors: tuple[float, float, float]) -> None:
    frames = [frame(camera) for camera in cameras()]
    capture(tmp_path, [*frames[:3], scaled(frames[3], factors)])
    with pytest.raises(BadInputError, match=r"back/000002\.JPG.*no rigid"):
        runner.ingest(tmp_path)


def test_folders_with_equal_names_keep_their_poses_intrinsics_and_masks(tmp_path: Path, runner: Runner) -> None:
    """Upper-case suffixes, an own focal length for each frame, and masks by name in the same folders."""
    capture(tmp_path, [frame(camera) for camera in cameras()])
    write_masks(tmp_path, [f"masks/{name.removesuffix('.JPG')}.PNG" for name in FILES])
    results, done = runner.ingest(tmp_path)
    assert results["posed"] == 4 and results["masks"] == 4 and not done.warnings
    found = {c.name: c for c in CameraSet.load(done.out / "poses" / "cameras.json").cameras}
    for k, camera in enumerate(cameras()):
        name = camera.name.replace("/", "_").removesuffix(".JPG")
        assert found[name].fx == pytest.approx(camera.fx) and np.allclose(found[name].centre, camera.centre)
        written = cv2.imread(str(done.out / "masks" / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        assert written is not None and (written == mask(10 + k)).all()


def test_masks_that_frames_name(tmp_path: Path, runner: Runner) -> None:
    """Names of their own, in two folders; a folder `masks` with other masks is not used."""
    names = write_masks(tmp_path, ["cut/f/one.png", "cut/f/two.png", "cut/b/one.png", "cut/b/two.png"])
    write_masks(tmp_path, [f"masks/{name.removesuffix('.JPG')}.png" for name in reversed(FILES)])
    slashes = [*names[:3], names[3].replace("/", "\\")]
    capture(tmp_path, [frame(camera, mask_path=name) for camera, name in zip(cameras(), slashes, strict=True)])
    assert discover(tmp_path).masks == tmp_path / "cut"  # its files are part of the key
    results, done = runner.ingest(tmp_path)
    assert results["masks"] == 4
    for k, camera in enumerate(cameras()):
        written = cv2.imread(str(done.out / "masks" / f"{camera.name.replace('/', '_').removesuffix('.JPG')}.png"), cv2.IMREAD_GRAYSCALE)
        assert written is not None and (written == mask(10 + k)).all()


def test_masks_that_frames_name_beside_others(tmp_path: Path, runner: Runner) -> None:
    """Two frames name masks in the folder `masks`; the other photos find theirs there by name."""
    write_masks(tmp_path, ["masks/x.png", "masks/y.png", "masks/back/000001.png", "masks/back/000002.png"])
    frames = [frame(camera) for camera in cameras()]
    capture(tmp_path, [frames[0] | {"mask_path": "masks/x.png"}, frames[1] | {"mask_path": "./masks/y.png"}, *frames[2:]])
    results, done = runner.ingest(tmp_path)
    assert results["masks"] == 4
    written = cv2.imread(str(done.out / "masks" / "back_000002.png"), cv2.IMREAD_GRAYSCALE)
    assert written is not None and (written == mask(13)).all()


def test_masks_given_otherwise_win(tmp_path: Path, runner: Runner) -> None:
    write_masks(tmp_path, ["mine/front/000001.png"])
    capture(tmp_path, [frame(camera, mask_path="gone.png") for camera in cameras()])
    results, done = runner.ingest(tmp_path, masks=tmp_path / "mine")
    assert results["masks"] == 1 and done.line("mask_path") == "not used (4 frames name a mask; other masks were given)"
    assert Runner(tmp_path / "none").ingest(tmp_path, settings={"masks": "ignore"})[0]["masks"] == 0


def test_missing_masks_are_listed(tmp_path: Path, runner: Runner) -> None:
    write_masks(tmp_path, ["cut/0.png"])
    capture(tmp_path, [frame(camera, mask_path=f"cut/{k}.png") for k, camera in enumerate(cameras())])
    words = r"3 masks that .*transforms\.json names do not exist \(cut/1\.png, cut/2\.png, cut/3\.png\); .*--masks none"
    with pytest.raises(BadInputError, match=words):
        runner.ingest(tmp_path)
    (tmp_path / "cut" / "0.png").unlink()
    with pytest.raises(BadInputError, match="4 masks that"):
        Runner(tmp_path / "again").ingest(tmp_path)


@pytest.mark.parametrize("name", ["../secret.png", "{}/secret.png", "link/secret.png"])
def test_masks_outside_the_folder_are_not_read(tmp_path: Path, name: str) -> None:
    root, outside = tmp_path / "capture", tmp_path / "elsewhere"
    write_masks(outside, ["secret.png"])
    capture(root, [frame(camera, mask_path=name.format(outside)) for camera in cameras()])
    (root / "link").symlink_to(outside)
    with pytest.raises(BadInputError, match=r"4 masks that .* lie outside its folder .*--masks"):
        discover(root)


@pytest.mark.parametrize("name", ["n" * 300, "n" * 300 + "/a.png", "loop/a.png"])
def test_masks_that_no_system_can_open_do_not_exist(tmp_path: Path, runner: Runner, name: str) -> None:
    capture(tmp_path, [frame(camera, mask_path=name) for camera in cameras()])
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(BadInputError, match="1 masks that .* do not exist"):
        runner.ingest(tmp_path)


def test_one_frame_without_a_mask_does_not_hide_those_of_others(tmp_path: Path, runner: Runner) -> None:
    """An empty name is none; what is no name is refused, not passed over with all masks of the file."""
    names = ["", *write_masks(tmp_path, [f"cut/{k}.png" for k in range(3)])]
    frames = [frame(camera, mask_path=name) for camera, name in zip(cameras(), names, strict=True)]
    capture(tmp_path, frames)
    assert runner.ingest(tmp_path)[0]["masks"] == 3
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frames[0] | {"mask_path": 5}, *frames[1:]]}))
    with pytest.raises(BadInputError, match=r"frames\.0\.mask_path: input should be a valid string"):
        Runner(tmp_path / "again").ingest(tmp_path)


def test_depths_of_frames_are_said_to_be_unused(tmp_path: Path, runner: Runner) -> None:
    frames = [frame(camera) for camera in cameras()]
    capture(tmp_path, [frames[0] | {"depth_file_path": "depth/a.png"}, frames[1] | {"depth_file_path": 7}, *frames[2:]])
    _, done = runner.ingest(tmp_path)
    assert done.line("depth_file_path").startswith("not used (2 frames of transforms.json have one; depth maps are read from")


def test_masks_and_photos_that_are_missing_are_listed_up_to_ten(tmp_path: Path, runner: Runner) -> None:
    frames = [frame(camera) for camera in cameras()]
    capture(tmp_path, [*frames[:3], *(frames[0] | {"file_path": f"images/gone{k:02}.jpg"} for k in range(12))])
    _, done = runner.ingest(tmp_path)
    lost = ", ".join(f"images/gone{k:02}.jpg" for k in range(10))
    assert f"12 frames of transforms.json have no photo ({lost} and 2 more)." in done.warnings
    assert "1 photos have no pose in transforms.json (back_000002) and will not be used." in done.warnings
    write_masks(tmp_path, [f"masks/{k:02}.png" for k in range(12)])
    with pytest.raises(BadInputError, match=r"no photo belongs to 00\.png, .*09\.png and 2 more; name masks"):
        Runner(tmp_path / "again").ingest(tmp_path)
