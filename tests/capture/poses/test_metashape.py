"""Cameras of Agisoft Metashape: points are projected as its manual says, and what has no equal here is refused."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsbake.capture.poses.frames import GivenPoses, PhotoSize
from gsbake.capture.poses.given import read_poses
from gsbake.errors import BadInputError

SIZE = PhotoSize(600, 400)
NEW = "<f>700</f><cx>6</cx><cy>-4</cy><k1>-0.08</k1><k2>0.02</k2><k3>0.001</k3><p1>0.003</p1><p2>-0.002</p2><b1>1.5</b1>"


def document(calibration: str = NEW, transform: str | None = None, kind: str = "frame", scale: str = "") -> str:
    """A file with one camera, turned and moved, and one that is not aligned."""
    angle = np.deg2rad(30)
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = 1, 2, -3
    transform = transform if transform is not None else " ".join(map(repr, pose.ravel().tolist()))
    return (
        f'<document version="1.5.0"><chunk><sensors><sensor id="0" type="{kind}"><resolution width="600" height="400"/>'
        f'<calibration type="{kind}" class="initial"><resolution width="600" height="400"/><f>1</f></calibration>'
        f'<calibration type="{kind}" class="adjusted"><resolution width="600" height="400"/>{calibration}</calibration></sensor></sensors>'
        f'<cameras><camera id="0" label="a" sensor_id="0"><transform>{transform}</transform></camera>'
        f'<camera id="1" label="b" sensor_id="0"/></cameras>{scale}</chunk></document>'
    )


def read(tmp_path: Path, text: str) -> GivenPoses:
    path = tmp_path / "cameras.xml"
    path.write_text(text)
    return read_poses(path, ["a.jpg", "b.jpg"], {"a.jpg": SIZE, "b.jpg": SIZE})


def seen(found: GivenPoses, points: np.ndarray) -> np.ndarray:
    """Pixels of points by OpenCV, with the camera that was read."""
    camera = found.cameras["a.jpg"]
    distortion = np.array(camera.distortion, float) if camera.distortion else np.zeros(4)
    return cv2.projectPoints(points, cv2.Rodrigues(camera.R)[0], camera.t, camera.K, distortion)[0][:, 0]


def test_points_are_seen_where_metashape_sees_them(tmp_path: Path) -> None:
    """The manual's formulas, written out here, against OpenCV's model with the coefficients that were read."""
    found = read(tmp_path, document())
    assert list(found.cameras) == ["a.jpg"]
    angle, rng = np.deg2rad(30), np.random.default_rng(0)
    to_world = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    local = np.column_stack([rng.uniform(-0.4, 0.4, 20), rng.uniform(-0.25, 0.25, 20), np.ones(20)]) * rng.uniform(2, 5, (20, 1))
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    r2 = x * x + y * y
    radial = 1 - 0.08 * r2 + 0.02 * r2**2 + 0.001 * r2**3
    xd = x * radial + 0.003 * (r2 + 2 * x * x) - 0.002 * 2 * x * y
    yd = y * radial - 0.002 * (r2 + 2 * y * y) + 0.003 * 2 * x * y
    expected = np.column_stack([300 + 6 + xd * (700 + 1.5), 200 - 4 + yd * 700])
    np.testing.assert_allclose(seen(found, local @ to_world.T + [1, 2, -3]), expected, atol=1e-6)


def test_old_files_have_the_principal_point_from_the_corner(tmp_path: Path) -> None:
    """Version 1.1: fx, fy, cx, cy in pixels."""
    camera = read(tmp_path, document("<fx>700</fx><fy>701</fy><cx>306</cx><cy>196</cy>")).cameras["a.jpg"]
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion) == (700, 701, 306, 196, ())


def test_the_region_of_the_chunk_is_read_in_its_units(tmp_path: Path) -> None:
    more = (
        "<transform><scale>2</scale></transform>"
        "<region><center>1 2 3</center><size>.5 1 2</size><R>0 -1 0 1 0 0 0 0 1</R></region>"
    )  # fmt: skip
    region = read(tmp_path, document(scale=more)).region
    assert region is not None and region.centre.tolist() == [2, 4, 6] and region.size.tolist() == [1, 2, 4]
    assert region.contains(np.array([[2 + 0.9, 4 + 0.4, 6 + 1.9], [2 + 0.4, 4 + 0.9, 6]])).tolist() == [True, False]
    assert read(tmp_path, document()).region is None
    for wrong, message in (("1 2", "not a centre"), ("1 2 x", "other things"), ("1 2 0", "is no box")):
        found = read(tmp_path, document(scale=more.replace(".5 1 2", wrong)))  # cameras count, whatever the box is
        assert found.region is None and list(found.cameras) == ["a.jpg"]
        assert message in found.warnings[0] and found.warnings[0].endswith("No region is used.")


def test_the_scale_of_the_chunk_gives_metres(tmp_path: Path) -> None:
    """Scale bars: coordinates times the chunk's scale."""
    camera = read(tmp_path, document(scale="<transform><scale>0.5</scale></transform>")).cameras["a.jpg"]
    np.testing.assert_allclose(camera.centre, [0.5, 1, -1.5], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (document(kind="fisheye"), "of the type fisheye"),
        (document(NEW + "<k4>5</k4>"), "coefficient k4"),
        (document(NEW + "<b2>9</b2>"), "coefficient b2"),
        (document(transform="1 0 0"), "not a valid file of Metashape"),
        (document(transform="2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"), "no rigid motion"),
        (document(transform=" ".join(["nan"] * 16)), "NaN"),
        (document("<f>-5</f>"), "a.jpg|frame a"),
        (document(scale="<transform><scale>-1</scale></transform>"), "scale of the chunk"),
        ("<document><chunk/></document>", "no aligned camera"),
        ("<document>", "not a valid XML file"),
        ("<other/>", "no file of Metashape cameras"),
        ('<!DOCTYPE d [<!ENTITY a "aaaa">]><document><chunk>&a;</chunk></document>', "XML entities"),
    ],
)
def test_wrong_files_end_in_a_sentence(tmp_path: Path, text: str, message: str) -> None:
    """Models without an equal here, and damaged files."""
    with pytest.raises(BadInputError, match=message) as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_what_cameras_lack_is_listed(tmp_path: Path) -> None:
    """A sensor that is not in the file, and one without a calibration or a resolution."""
    one, two = '<camera id="0" label="a" sensor_id="0">', '<camera id="2" label="b" sensor_id="7"><transform>x</transform></camera>'
    with pytest.raises(BadInputError, match=r"lack fields \(b: sensor, a: resolution\)"):
        read(tmp_path, re.sub("<resolution[^>]*>", "", document()).replace(one, two + one))
    with pytest.raises(BadInputError, match=r"lack fields \(a: calibration\)"):
        read(tmp_path, re.sub("<calibration.*</calibration>", "", document()))


def test_a_real_file() -> None:
    """Fifty cameras of a real project with two sensors, from 5184 pixels to the photos' 1200."""
    path = Path(__file__).resolve().parents[4] / "shared" / "captures" / "axe" / "gt" / "agisoft_cameras.xml"
    if not path.is_file():
        pytest.skip("the capture axe is not here")
    names = [f"IMG_{number}.jpg" for number in range(8835, 8889)]
    found = read_poses(path, names, dict.fromkeys(names, PhotoSize(1200, 800)))
    assert len(found.cameras) == 50
    assert {round(camera.fx) for camera in found.cameras.values()} == {round(12150.56 * 1200 / 5184), round(12164.27 * 1200 / 5184)}
