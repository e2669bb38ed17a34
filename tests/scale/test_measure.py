"""The metric scale by known distances and markers, and what cannot be measured."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from gsbake.config.schema import Scale
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, Camera, CameraSet, Similarity
from gsbake.geometry.raycast import RayCaster
from gsbake.scale.measure import MetricScale, measure_scale
from tests.scale.test_markers import EDGE, photograph, ring
from tests.scale.test_triangulation import COEFFICIENTS, seen
from tests.support.recorder import Recorder

#: Unit frame to world, and the radius of the object, a ball, in the unit frame.
TO_WORLD = Similarity(0.5, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.1, 0.05, 0.0]))
RADIUS = 0.8
#: Two points beside the object, one unit apart, and how many metres that shall be.
A, B, METRES = np.array([0.4, -0.5, 0.0]), np.array([0.4, 0.5, 0.0]), 0.12


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Six working photos at half the size of the user's files, the last one not registered."""
    for sub in ("ingest/photos", "poses"):
        (tmp_path / sub).mkdir(parents=True)
    cameras = ring()
    entries = [
        {"name": f"a_{c.name}", "source": f"a/{c.name}.jpg", "source_width": 2 * c.width, "source_height": 2 * c.height} for c in cameras
    ]
    (tmp_path / "ingest/photos.json").write_text(json.dumps({"photos": entries}))
    registered = tuple(replace(c, name=f"a_{c.name}", distortion=COEFFICIENTS) for c in cameras[:5])
    CameraSet(registered).save(tmp_path / "poses/photo_cameras.json")
    return tmp_path


def pick(folder: Path, point: Array, photos: tuple[int, ...]) -> str:
    """A point as the user would give it, in pixels of the user's files."""
    cameras = CameraSet.load(folder / "poses/photo_cameras.json").cameras
    pixels = [2 * seen(cameras[i], point) for i in photos]
    return "+".join(f"{i}.jpg:{x:.3f},{y:.3f}" for i, (x, y) in zip(photos, pixels, strict=True))


def ball() -> RayCaster:
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    return RayCaster(mesh.vertices, mesh.faces)


def measure(folder: Path, *texts: str, monitor: Recorder | None = None, **settings: float) -> MetricScale | None:
    options = Scale(known_distances=texts, **settings)  # type: ignore[arg-type]
    return measure_scale(folder / "ingest", folder / "poses", options, ball(), TO_WORLD, monitor=monitor or Recorder())


def test_nothing_is_measured_unless_it_is_asked_for(capture: Path) -> None:
    (capture / "poses/photo_cameras.json").unlink()
    assert measure(capture) is None


def test_points_beside_the_object_are_triangulated(capture: Path) -> None:
    scale = measure(capture, f"{pick(capture, A, (0, 3))} {pick(capture, B, (1, 2, 4))} 12cm")
    assert scale is not None
    assert scale.metres == pytest.approx(METRES, rel=1e-4)
    assert 1e-4 < scale.relative_error < 0.02


def test_points_on_the_object_need_one_photo(capture: Path) -> None:
    cameras = CameraSet.load(capture / "poses/photo_cameras.json").cameras
    on = [TO_WORLD.apply(RADIUS * d / np.linalg.norm(d)) for d in (np.array([1.0, -0.6, 0.9]), np.array([0.7, 0.1, 1.2]))]
    middle = cameras[2].centre
    assert all((p - TO_WORLD.translation) @ (middle - p) > 0 for p in on)  # both face the camera
    scale = measure(capture, f"{pick(capture, on[0], (2,))} {pick(capture, on[1], (2,))} 30mm")
    assert scale is not None
    assert scale.metres == pytest.approx(0.03 / np.linalg.norm(on[0] - on[1]), rel=2e-3)


def test_several_measurements_are_weighted_and_a_contradiction_is_reported(capture: Path) -> None:
    monitor = Recorder()
    good = f"{pick(capture, A, (0, 1, 3, 4))} {pick(capture, B, (0, 1, 3, 4))}"
    scale = measure(capture, f"{good} 12cm", f"{good} 12.1cm", monitor=monitor)
    assert scale is not None and 0.12 < scale.metres < 0.121 and not monitor.warnings
    measure(capture, f"{good} 12cm", f"{good} 16cm", monitor=monitor)
    assert len(monitor.warnings) == 2 and "check its points and its length" in monitor.warnings[0]


def test_markers_give_the_scale(capture: Path) -> None:
    cameras: list[Camera] = [replace(c, distortion=()) for c in CameraSet.load(capture / "poses/photo_cameras.json").cameras]
    CameraSet(tuple(cameras)).save(capture / "poses/photo_cameras.json")
    photograph(capture / "ingest/photos", cameras, "aruco-6x6", 3)
    scale = measure(capture, marker_size=0.05)
    assert scale is not None and scale.metres == pytest.approx(0.05 / EDGE, rel=0.002)
    assert "marker 3 (aruco-6x6, 5 photos)" in scale.evidence


def test_without_a_marker_the_scale_stays_unknown(capture: Path) -> None:
    for i in range(5):
        cv2.imwrite(str(capture / f"ingest/photos/a_{i}.png"), np.full((360, 480), 128, np.uint8))
    monitor = Recorder()
    assert measure(capture, marker_size=0.05, monitor=monitor) is None
    assert "No printed marker" in monitor.warnings[0]


@pytest.mark.parametrize(
    ("first", "message"),
    [
        ("nobody.jpg:1,2", "names the photo 'nobody.jpg', which is none of the photos"),
        ("5.jpg:1,2", "was not registered"),
        ("0.jpg:961,2", "lies outside the photo 0.jpg \\(960 × 720 pixels\\)"),
        ("0.jpg:0,2", "is not on the object in 0.jpg; give it in a second photo"),
        ("0.jpg:50,60+0.jpg:50,60", "from nearly the same direction"),
    ],
)
def test_points_that_cannot_be_measured(capture: Path, first: str, message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        measure(capture, f"{first} {pick(capture, B, (1, 3))} 12cm")


def test_two_equal_points_have_no_distance(capture: Path) -> None:
    with pytest.raises(BadInputError, match="are the same point"):
        measure(capture, f"{pick(capture, A, (0, 3))} {pick(capture, A, (0, 3))} 12cm")
