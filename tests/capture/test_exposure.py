"""Exposure from tie points: real changes are found; specular points and clipped values do not count as one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsbake.capture.exposure import MIN_POINTS, TiePointExposure, written_exposures
from gsbake.capture.poses.colmap_model import read_tracks
from gsbake.geometry.cameras import Camera
from gsbake.imaging.srgb import decode_bytes, encode_bytes

PHOTOS, POINTS, SIDE = 9, 400, 400


def tie_points(gain: np.ndarray, specular_share: float = 0.0, count: int = POINTS) -> TiePointExposure:
    """Photos with `gain` (photos,) of `count` points of random albedo; a share `specular_share` of them has random brightness in each."""
    rng = np.random.default_rng(4)
    columns = int(np.ceil(np.sqrt(count)))
    x, y = np.divmod(np.arange(count), columns)
    points = np.column_stack([(x + 0.5) / columns - 0.5, (y + 0.5) / columns - 0.5, np.zeros(count)])
    albedo = rng.uniform(0.05, 0.3, count)
    specular = rng.random(count) < specular_share
    names = [f"p{k}" for k in range(len(gain))]
    visible = {name: np.sort(rng.choice(count, int(0.6 * count), replace=False)) for name in names}
    tie_point_exposure = TiePointExposure(points, visible)
    edge = SIDE // columns
    for k, name in enumerate(names):
        camera = Camera(name, SIDE, SIDE, SIDE, SIDE, SIDE / 2, SIDE / 2, np.eye(3), np.array([0, 0, 1.0]))
        colour = albedo * np.where(specular, rng.uniform(0.7, 2.5, count), 1) * gain[k]
        grid = np.zeros((columns, columns))
        grid[y, x] = colour
        image = np.kron(grid, np.ones((edge, edge)))
        full = np.full((SIDE, SIDE), 0.1)
        full[: image.shape[0], : image.shape[1]] = image
        tie_point_exposure.add(camera, decode_bytes(encode_bytes(np.repeat(np.clip(full, 0, 1)[..., None], 3, 2))))
    return tie_point_exposure


def entry(exposure: float | None, **other: object) -> dict[str, object]:
    return {"light_exposure": exposure, "flash": False, "camera_model": "Maker One 50 mm", "camera_body": None, **other}


def test_written_exposures_are_relative() -> None:
    found = written_exposures([entry(0.1), entry(0.4), entry(0.2)])
    assert found == pytest.approx([-np.log(2), np.log(2), 0])


@pytest.mark.parametrize("other", [entry(None), entry(0.1, flash=True), entry(0.1, camera_model="Maker Two"), entry(0.1, camera_body="1")])
def test_exposures_that_cannot_be_compared_are_not_known(other: dict[str, object]) -> None:
    assert written_exposures([entry(0.1), other]) is None and written_exposures([]) is None


def test_equal_exposures_have_no_spread() -> None:
    assert tie_points(np.ones(PHOTOS)).spread() == pytest.approx(1, abs=0.01)


def test_specular_points_do_not_change_the_exposure() -> None:
    assert tie_points(np.ones(PHOTOS), specular_share=0.3).spread() == pytest.approx(1, abs=0.03)


def test_the_spread_is_that_of_most_photos() -> None:
    gain = np.array([1 / 1.4] * 3 + [1.0] * 3 + [1.4] * 3)
    assert tie_points(gain).spread() == pytest.approx(1.4, rel=0.03)
    one = np.ones(20)
    one[7] = 3.0
    assert tie_points(one).spread() == pytest.approx(1, abs=0.02)


def test_tracks_of_a_model_are_read(tmp_path: Path) -> None:
    from gsbake.capture.colmap import pycolmap

    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D = 50
    model = pycolmap.synthesize_dataset(options)
    model.write(str(tmp_path))
    points, visible = read_tracks(tmp_path)
    assert points.shape == (50, 3) and len(visible) == model.num_images()
    assert sum(map(len, visible.values())) == sum(p.track.length() for p in model.points3D.values())
    image = next(iter(model.images.values()))
    first = next(p for p in image.points2D if p.has_point3D())
    at = model.points3D[first.point3D_id].xyz
    assert np.abs(points[visible[Path(image.name).stem]] - at).sum(1).min() < 1e-9


def test_too_few_points_give_no_result() -> None:
    assert tie_points(np.ones(PHOTOS), count=MIN_POINTS - 50).spread() is None
