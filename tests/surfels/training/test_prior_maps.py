"""Given normals and depths: files of each format, resampled to the training photos, and clear errors."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from gsbake.api import _priors, _source_names
from gsbake.config.schema import Coupling
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import CameraSet
from gsbake.surfels.training.prior_maps import add_priors
from gsbake.surfels.views import TrainView, camera_tensors
from tests.support.cameras import look_at
from tests.support.large_files import png_header


def scene(folder: Path, distortion: tuple[float, ...] = ()) -> tuple[list[TrainView], CameraSet]:
    """Two photos of 40 × 40 pixels, trained at 20, distorted before the poses stage."""
    cameras = [look_at([0, -3, 0.1 + i], size=40, focal=50.0, name=f"p{i}") for i in range(2)]
    CameraSet(tuple(replace(c, distortion=distortion) for c in cameras)).save(folder / "photo_cameras.json")
    views = []
    for camera in cameras:
        r, t, centre, pinhole = camera_tensors(camera.downscaled_to(20))
        views.append(TrainView(camera.name, torch.zeros(3, 20, 20, dtype=torch.uint8), None, r, t, centre, pinhole))
    return views, CameraSet(tuple(cameras))


def ramp(size: int) -> np.ndarray:
    """Depth 1 + x, with x the share of the width."""
    return np.broadcast_to(1 + (np.arange(size) + 0.5) / size, (size, size)).astype(np.float32)


@pytest.mark.parametrize("size", [40, 20, 80])
@pytest.mark.parametrize("kind", ["npy", "png"])
def test_maps_of_any_size_are_resampled(tmp_path: Path, size: int, kind: str) -> None:
    views, cameras = scene(tmp_path)
    folders = [tmp_path / name for name in ("normals", "depths")]
    for folder in folders:
        folder.mkdir()
    n = np.zeros((size, size, 3), np.float32)
    n[:, : size // 2] = (0.6, 0, -0.8)
    n[:, size // 2 :] = (0, -0.6, -0.8)
    if kind == "npy":
        np.save(folders[0] / "p0.npy", n)
        np.save(folders[1] / "p0.npy", ramp(size))
    else:
        cv2.imwrite(str(folders[0] / "p0.png"), np.rint((n[..., ::-1] + 1) / 2 * 255).astype(np.uint8))
        cv2.imwrite(str(folders[1] / "p0.png"), np.rint(20000 * ramp(size)).astype(np.uint16))
    first, second = add_priors(views, cameras, tmp_path, *folders)
    assert second.normals is None and second.depths is None
    assert first.normals is not None and first.depths is not None
    got = first.normals.float() / 127
    assert torch.allclose(got[:, :, 3], torch.tensor([0.6, 0, -0.8])[:, None], atol=0.02)
    assert torch.allclose(got[:, :, 16], torch.tensor([0, -0.6, -0.8])[:, None], atol=0.02)
    depth = first.depths / (1 if kind == "npy" else 20000)
    assert float((depth - torch.from_numpy(ramp(20))).abs().max()) <= 1.01 / min(size, 20)


def test_maps_are_undistorted_like_the_photos(tmp_path: Path) -> None:
    views, cameras = scene(tmp_path, (0.2, 0.0, 0.0, 0.0))
    (tmp_path / "depths").mkdir()
    source = cameras.cameras[0]
    # each pixel of the distorted photo holds its own column
    np.save(tmp_path / "depths" / "p0.npy", np.broadcast_to(np.arange(40, dtype=np.float32) + 1, (40, 40)))
    depths = add_priors(views, cameras, tmp_path, None, tmp_path / "depths")[0].depths
    assert depths is not None
    x = (5 * 2 + 1 - source.cx) / source.fx  # of training pixel (5, 10)
    y = (10 * 2 + 1 - source.cy) / source.fy
    expected = x * (1 + 0.2 * (x * x + y * y)) * source.fx + source.cx
    assert abs(float(depths[10, 5]) - 1 - (expected - 0.5)) <= 0.5


@pytest.mark.parametrize("bad", ["text", "shape", "pickle", "grey normals"])
def test_a_file_that_is_no_map_is_an_error(tmp_path: Path, bad: str) -> None:
    views, cameras = scene(tmp_path)
    folder = tmp_path / "normals"
    folder.mkdir()
    if bad == "text":
        (folder / "p0.npy").write_text("no array")
    elif bad == "shape":
        np.save(folder / "p0.npy", np.zeros((4, 4, 2)))
    elif bad == "pickle":
        np.save(folder / "p0.npy", np.array([{}], object), allow_pickle=True)
    else:
        cv2.imwrite(str(folder / "p0.png"), np.zeros((8, 8), np.uint8))
    with pytest.raises(BadInputError, match="p0"):
        add_priors(views, cameras, tmp_path, folder, None)


def test_folders_beside_the_photos_are_sources_where_they_have_a_weight(tmp_path: Path) -> None:
    for name in ("images", "normals", "depths"):
        (tmp_path / name).mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.zeros((8, 8, 3), np.uint8))
    np.save(tmp_path / "normals" / "a.npy", np.zeros((8, 8, 3)))
    (tmp_path / "normals" / "notes.txt").write_text("x")
    project = SimpleNamespace(photos=str(tmp_path / "images"))
    assert _priors(project, SimpleNamespace(coupling=Coupling())) == {}
    found = _priors(project, SimpleNamespace(coupling=Coupling(prior_normals=0.1)))
    assert found == {"normals": tmp_path / "normals"}
    assert _source_names({"photos": tmp_path / "images"} | found)["normals"] == ["a.npy"]


def npy(shape: tuple[int, ...], dtype: str = "<f4") -> bytes:
    """A header that states a shape, and no numbers."""
    header = repr({"descr": dtype, "fortran_order": False, "shape": shape}).encode()
    header += b" " * ((-(10 + len(header) + 1)) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("p0.npy", npy((10**6, 10**6)), "states 4000000000000 bytes and holds 0"),
        ("p0.npy", npy((-1, 4)), "cannot be read"),
        ("p0.npy", npy((2, 2), "|O"), "cannot be read"),
        ("p0.npy", b"", "cannot be read"),
        ("p0.npy", npy((8, 8))[:20], "cannot be read"),
        ("p0.png", b"text", "must be PNG"),
        ("p0.png", png_header(30_000, 30_000), "30000 × 30000"),
        ("p0.png", png_header(9_000, 9_000), "needs 1.94 GB of memory"),
    ],
)
def test_maps_that_ask_for_more_than_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, content: bytes, message: str
) -> None:
    monkeypatch.setattr("gsbake.memory_budget.available_memory", lambda: 400_000_000)
    views, cameras = scene(tmp_path)
    (tmp_path / "depths").mkdir()
    (tmp_path / "depths" / name).write_bytes(content)
    with pytest.raises(BadInputError, match=message) as caught:
        add_priors(views, cameras, tmp_path, None, tmp_path / "depths")
    assert name in str(caught.value) and "\n" not in str(caught.value)
