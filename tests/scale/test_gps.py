"""The metric scale by GPS positions: metres on the ellipsoid, the fit, and what is too inaccurate to be used."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsbake.capture.photos.decode import read_photo
from gsbake.capture.photos.exif import gps_position
from gsbake.capture.photos.heic_and_raw import _exif_tags
from gsbake.config.schema import Scale
from gsbake.geometry.cameras import Array, CameraSet
from gsbake.scale.gps import gps_scale, local_metres
from gsbake.scale.measure import MetricScale, measure_scale
from tests.support.cameras import look_at
from tests.support.recorder import Recorder

TAGS = {
    "GPS:LatitudeRef": "S", "GPS:Latitude": (47.0, 30.0, 36.0), "GPS:LongitudeRef": "E", "GPS:Longitude": (8.0, 15.0, 0.0),
    "GPS:AltitudeRef": 1, "GPS:Altitude": 12.5,
}  # fmt: skip


def test_positions_in_exif() -> None:
    """Degrees, minutes and seconds; South, West and below the sea are negative."""
    assert gps_position(TAGS) == pytest.approx((-47.51, 8.25, -12.5))
    assert gps_position(TAGS | {"GPS:AltitudeRef": 0, "GPS:LongitudeRef": "W"}) == pytest.approx((-47.51, -8.25, 12.5))


def test_the_position_of_a_file(tmp_path: Path) -> None:
    """As a telephone writes it, by the library that reads photos."""
    exif = Image.Exif()
    exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 30.0, 36.0), 3: "W", 4: (8.0, 15.0, 0.0), 5: b"\x00", 6: 412.5})
    Image.new("RGB", (30, 20)).save(tmp_path / "a.jpg", exif=exif)
    assert gps_position(read_photo(tmp_path / "a.jpg").tags) == pytest.approx((47.51, -8.25, 412.5))
    assert gps_position(_exif_tags(exif.tobytes())) == pytest.approx((47.51, -8.25, 412.5))


@pytest.mark.parametrize(
    "change",
    [
        {"GPS:Latitude": (99.0, 0.0, 0.0)}, {"GPS:Latitude": (1.0, 2.0)}, {"GPS:Longitude": 8.0}, {"GPS:Altitude": float("nan")},
        {"GPS:Altitude": "x"},
    ],
)  # fmt: skip
def test_positions_that_are_none(change: dict[str, object]) -> None:
    assert gps_position(TAGS | change) is None
    assert gps_position({name: value for name, value in TAGS.items() if name not in change}) is None


def test_metres_on_the_ellipsoid() -> None:
    """A degree of latitude has 110.574 km at the equator and 111.694 km at the poles; one of longitude 111.320 km at the equator."""
    found = local_metres(np.array([[0.0, 179.9995, 0], [0.001, 179.9995, 5], [0, -179.9995, 0]]))
    np.testing.assert_allclose(found, [[0, 0, 0], [0, 110.574, 5], [111.320, 0, 0]], atol=2e-3)
    assert local_metres(np.array([[89.999, 0.0, 0], [90.0, 0, 0]]))[1, 1] == pytest.approx(111.694, abs=2e-3)


def flight(radius: float = 20.0, noise: float = 0.0) -> tuple[CameraSet, dict[str, list[float]]]:
    """Twelve cameras around an object in a frame of .05 units a metre, and their positions with a receiver's `noise` in metres."""
    rng = np.random.default_rng(0)
    angle = np.radians(np.arange(0, 360, 30))
    metres = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), radius * (0.4 + 0.2 * np.cos(2 * angle))])
    cameras = [replace(look_at(0.05 * eye, size=(320, 240)), name=f"p{k}") for k, eye in enumerate(metres)]
    off: Array = metres + noise * rng.normal(size=metres.shape)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # East is another direction than the cameras' x
    east, north, up = (off @ turn.T).T
    places = np.column_stack([north / 110574, east / 111320, 400 + up])
    return CameraSet(tuple(cameras), poses="solved"), {f"p{k}": place.tolist() for k, place in enumerate(places)}


def test_the_scale_of_a_flight() -> None:
    cameras, positions = flight()
    found = gps_scale(cameras.cameras, positions)
    assert found is not None and found.photos == 12
    assert found.metres == pytest.approx(20, rel=1e-4) and found.relative_error < 1e-3
    noisy = gps_scale(*((cameras.cameras, flight(noise=1.5)[1])))
    assert noisy is not None and abs(noisy.metres / 20 - 1) < 2 * noisy.relative_error and 0.005 < noisy.relative_error < 0.05


def test_what_says_nothing() -> None:
    cameras, positions = flight()
    assert gps_scale(cameras.cameras, {name: positions[name] for name in ("p0", "p1", "p2", "p3", "p4")}) is None
    assert gps_scale(cameras.cameras, dict.fromkeys(positions, [47.0, 8.0, 400.0])) is None
    assert gps_scale([replace(c, t=c.R @ np.ones(3)) for c in cameras.cameras], positions) is None


def measure(folder: Path, cameras: CameraSet, positions: dict[str, list[float]], gps: bool = True) -> tuple[MetricScale | None, Recorder]:
    for sub in ("ingest", "poses"):
        (folder / sub).mkdir(exist_ok=True)
    entries = [{"name": c.name, "gps": positions.get(c.name)} for c in cameras.cameras]
    (folder / "ingest/photos.json").write_text(json.dumps({"photos": entries}))
    cameras.save(folder / "poses/photo_cameras.json")
    recorder = Recorder()
    return measure_scale(folder / "ingest", folder / "poses", Scale(gps=gps), monitor=recorder), recorder


def test_only_solved_poses_and_accurate_positions_are_scaled(tmp_path: Path) -> None:
    """Given poses have the user's units; around a small object a receiver's error of metres says nothing, and the report says so."""
    cameras, positions = flight()
    found, recorder = measure(tmp_path, cameras, positions)
    assert found is not None and found.metres == pytest.approx(20, rel=1e-4) and "GPS positions of 12 photos" in recorder.line("scale")
    assert measure(tmp_path, cameras, positions, gps=False)[0] is None
    assert measure(tmp_path, CameraSet(cameras.cameras, poses="given"), positions)[0] is None
    near, recorder = measure(tmp_path, *flight(0.5, noise=3.0))
    assert near is None and "unknown" in recorder.line("scale")
    assert measure(tmp_path, cameras, {})[0] is None
