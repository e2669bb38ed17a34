"""Cameras of RealityScan, OpenSfM, OpenMVG and Polycam: points are projected as each program's formulas, written out here, say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.capture.poses.frames import GivenPoses, PhotoSize
from gsbake.capture.poses.given import read_poses
from gsbake.capture.sources import discover
from gsbake.errors import BadInputError

Array = NDArray[np.float64]
SIZE = PhotoSize(600, 400)
SIZES = {"a.jpg": SIZE, "b.jpg": SIZE}
CENTRE = np.array([1.0, 2.0, -3.0])
K1, K2, K3, T1, T2 = -0.08, 0.02, 0.001, 0.003, -0.002


def turn(axis: int, degrees: float) -> Array:
    """Rotation about an axis, by the right-hand rule."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


#: World → camera: x right, y down, z forward.
TO_CAMERA = turn(2, 20) @ turn(0, 70) @ turn(1, -35)


def local_points() -> Array:
    """Points (20, 3) in front of the camera, in its frame."""
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-0.4, 0.4, 20), rng.uniform(-0.25, 0.25, 20), np.ones(20)]) * rng.uniform(2, 5, (20, 1))


def distorted(local: Array, p1: float, p2: float) -> tuple[Array, Array]:
    """Brown's model, with OpenCV's order of the tangential coefficients."""
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    r2 = x * x + y * y
    radial = 1 + K1 * r2 + K2 * r2**2 + K3 * r2**3
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def seen(found: GivenPoses, points: Array) -> Array:
    """Pixels of world points by OpenCV, with the camera of a.jpg that was read."""
    camera = found.cameras["a.jpg"]
    distortion = np.array(camera.distortion, float) if camera.distortion else np.zeros(4)
    return np.asarray(cv2.projectPoints(points, cv2.Rodrigues(camera.R)[0], camera.t, camera.K, distortion)[0][:, 0])


def read(path: Path) -> GivenPoses:
    return read_poses(path, list(SIZES), SIZES)


def xmp(model: str = "brown3t2", position: str | None = None, rotation: str | None = None, more: str = 'xcr:Skew="0"') -> str:
    """An XMP file as RealityScan writes it."""
    rotation = rotation or " ".join(map(repr, TO_CAMERA.ravel().tolist()))
    position = " ".join(map(repr, CENTRE.tolist())) if position is None else position
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
        f'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" xcr:DistortionModel="{model}" xcr:FocalLength35mm="42" '
        f'{more} xcr:PrincipalPointU="0.01" xcr:PrincipalPointV="-0.005"><xcr:Rotation>{rotation}</xcr:Rotation>'
        + (f"<xcr:Position>{position}</xcr:Position>" if position else "")
        + f"<xcr:DistortionCoeficients>{K1} {K2} {K3} 0 {T1} {T2}</xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>"
    )


def expected_by_reality_scan(local: Array) -> Array:
    xd, yd = distorted(local, T2, T1)
    return np.column_stack([300 + 6 + xd * 700, 200 - 3 + yd * 700])


def test_xmp_of_reality_scan(tmp_path: Path) -> None:
    """42 mm of 36 at 600 pixels are 700 pixels; one hundredth of 600 is 6."""
    (tmp_path / "a.xmp").write_text(xmp())
    (tmp_path / "b.xmp").write_text(xmp(position=""))  # not aligned
    found = read(tmp_path)
    assert list(found.cameras) == ["a.jpg"]
    local = local_points()
    np.testing.assert_allclose(seen(found, local @ TO_CAMERA + CENTRE), expected_by_reality_scan(local), atol=1e-6)


HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"


def csv_row(k4: float = 0.0, heading: object = 25.0) -> str:
    return f"a.jpg,1,2,-3,{heading},80,-10,42,0.01,-0.005,{K1},{K2},{K3},{k4},{T1},{T2}"


@pytest.mark.parametrize("first", ["", "#cameras 1\n"])
def test_csv_of_reality_scan(tmp_path: Path, first: str) -> None:
    """A camera without angles looks down with North above; roll, then pitch, then heading (clockwise) turn it."""
    (tmp_path / "c.csv").write_text(f"{first}{HEADER}\n{csv_row()}\n")
    found = read(tmp_path / "c.csv")
    local = local_points()
    opengl = local * [1, -1, -1]
    world = opengl @ (turn(2, -25) @ turn(0, 80) @ turn(1, -10)).T + CENTRE
    np.testing.assert_allclose(seen(found, world), expected_by_reality_scan(local), atol=1e-6)


def test_csv_without_angles_looks_down(tmp_path: Path) -> None:
    """From above, a point in the East is to the right and one in the North above the centre."""
    (tmp_path / "c.csv").write_text("name,x,y,alt,heading,pitch,roll,f\na.jpg,0,0,10,0,0,0,36\n")
    pixels = seen(read(tmp_path / "c.csv"), np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    np.testing.assert_allclose(pixels, [[300, 200], [360, 200], [300, 140]], atol=1e-9)


def opensfm(**changes: Any) -> list[dict[str, Any]]:
    vector = cv2.Rodrigues(TO_CAMERA)[0].ravel()
    lens = {
        "projection_type": "brown", "width": 600, "height": 400, "focal_x": 700 / 600, "focal_y": 690 / 600, "c_x": 0.01, "c_y": -0.005,
        "k1": K1, "k2": K2, "k3": K3, "p1": T1, "p2": T2,
    }  # fmt: skip
    shot = {"rotation": vector.tolist(), "translation": (-TO_CAMERA @ CENTRE).tolist(), "camera": "v2 lens"}
    other: dict[str, Any] = {"cameras": {}, "shots": {}, "points": {}}
    points = {"7": {"coordinates": [1, 2, 3.5], "color": [255.0, 0.0, 127.4]}}
    return [other, {"cameras": {"v2 lens": {**lens, **changes}}, "shots": {"a.jpg": shot}, "points": points, "biases": {}}]


def test_opensfm(tmp_path: Path) -> None:
    """Units of the longer side, an angle-axis vector, and the reconstruction with most shots; its points come along."""
    (tmp_path / "reconstruction.json").write_text(json.dumps(opensfm()))
    found = read(tmp_path / "reconstruction.json")
    local = local_points()
    xd, yd = distorted(local, T1, T2)
    expected = np.column_stack([306 + xd * 700, 197 + yd * 690])
    np.testing.assert_allclose(seen(found, local @ TO_CAMERA + CENTRE), expected, atol=1e-6)
    assert found.points is not None and found.points.tolist() == [[1, 2, 3.5]]
    assert found.colours is not None and found.colours.tolist() == [[255, 0, 127]]


def test_opensfm_with_one_focal_length(tmp_path: Path) -> None:
    """The model `perspective` has neither a principal point nor tangential distortion."""
    body = opensfm(projection_type="perspective", focal=1.1, focal_x=None, focal_y=None, c_x=0.0, c_y=0.0)
    (tmp_path / "r.json").write_text(json.dumps(body))
    camera = read(tmp_path / "r.json").cameras["a.jpg"]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (pytest.approx(660), pytest.approx(660), 300, 200)


def openmvg(nested: bool = True, lens: dict[str, Any] | None = None) -> dict[str, Any]:
    pinhole = {"width": 600, "height": 400, "focal_length": 700.0, "principal_point": [305.5, 196.5]}
    lens = lens if lens is not None else {"disto_t2": [K1, K2, K3, T1, T2]}
    lens = {"value0": pinhole, **lens} if nested else {**pinhole, **lens}
    views = [
        {"key": k, "value": {"polymorphic_id": 1 << 30, "ptr_wrapper": {"id": k, "data": {
            "local_path": "", "filename": name, "width": 600, "height": 400, "id_view": k, "id_intrinsic": 0, "id_pose": k,
        }}}} for k, name in enumerate(("a.jpg", "b.jpg"))
    ]  # fmt: skip
    return {
        "sfm_data_version": "0.3",
        "root_path": "images",
        "views": views,
        "intrinsics": [{"key": 0, "value": {"polymorphic_id": 1, "ptr_wrapper": {"id": 9, "data": lens}}}],
        "extrinsics": [{"key": 0, "value": {"rotation": TO_CAMERA.tolist(), "center": CENTRE.tolist()}}],
        "structure": [],
    }


@pytest.mark.parametrize("nested", [True, False])
def test_openmvg(tmp_path: Path, nested: bool) -> None:
    """Rotation and centre; pixel centres at whole numbers; a view without a pose is left out."""
    (tmp_path / "sfm_data.json").write_text(json.dumps(openmvg(nested), indent=2))
    found = read(tmp_path / "sfm_data.json")
    assert list(found.cameras) == ["a.jpg"]
    local = local_points()
    xd, yd = distorted(local, T1, T2)
    expected = np.column_stack([306 + xd * 700, 197 + yd * 700])
    np.testing.assert_allclose(seen(found, local @ TO_CAMERA + CENTRE), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("lens", "distortion"), [({}, ()), ({"disto_k1": [0.1]}, (0.1, 0, 0, 0, 0)), ({"disto_k3": [0.1, 0.2, 0.3]}, (0.1, 0.2, 0, 0, 0.3))]
)
def test_models_of_openmvg(tmp_path: Path, lens: dict[str, Any], distortion: tuple[float, ...]) -> None:
    (tmp_path / "s.json").write_text(json.dumps(openmvg(lens=lens)))
    assert read(tmp_path / "s.json").cameras["a.jpg"].distortion == distortion


def polycam(rotation: Array, centre: Array) -> dict[str, Any]:
    """ARKit's camera-to-world matrix in a world with Y up, of a camera with OpenGL axes."""
    matrix = np.column_stack([rotation, centre])
    entries = {f"t_{i}{j}": matrix[i, j] for i in range(3) for j in range(4)}
    return {"fx": 700.0, "fy": 690.0, "cx": 305.5, "cy": 196.5, "width": 600, "height": 400, "blur_score": 90, **entries}


def test_polycam(tmp_path: Path) -> None:
    """The world is turned from Y up to Z up: (x, y, z) becomes (x, −z, y)."""
    folder = tmp_path / "keyframes" / "corrected_cameras"
    folder.mkdir(parents=True)
    rotation = TO_CAMERA.T @ np.diag([1.0, -1, -1])
    (folder / "a.json").write_text(json.dumps(polycam(rotation, CENTRE)))
    (tmp_path / "a.jpg").touch()
    poses = discover(tmp_path, poses=tmp_path).poses
    assert poses == folder
    local = local_points()
    world = local @ TO_CAMERA + CENTRE
    turned = np.column_stack([world[:, 0], -world[:, 2], world[:, 1]])
    expected = np.column_stack([306 + local[:, 0] / local[:, 2] * 700, 197 + local[:, 1] / local[:, 2] * 690])
    np.testing.assert_allclose(seen(read(folder), turned), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.xmp", xmp(model="division"), "distortion model division"),
        ("a.xmp", xmp(rotation="1 0 0"), "Rotation has 3 numbers"),
        ("a.xmp", xmp(rotation=" ".join(["2"] * 9)), "no rigid motion"),
        ("a.xmp", xmp(more='xcr:Skew="0.1"'), "skew"),
        ("a.xmp", xmp(more='xcr:AspectRatio="nan"'), "AspectRatio"),
        ("a.xmp", xmp(position="1 2 nan"), "Position"),
        ("a.xmp", xmp(position=""), "No XMP file"),
        ("a.xmp", "<!DOCTYPE x>", "XML entities"),
        ("a.xmp", "<a", "not a valid XML file"),
        ("c.csv", f"{HEADER}\n{csv_row(k4=5.0)}\n", "coefficient k4"),
        ("c.csv", f"{HEADER}\n{csv_row(heading='nan')}\n", "row 2 has no name"),
        ("c.csv", f"{HEADER}\n{csv_row(heading='x')}\n", "not a valid CSV file of RealityScan"),
        ("c.csv", f"{HEADER}\na.jpg,1\n", "not a valid CSV file of RealityScan"),
        ("c.csv", "name,x\n", "lacks columns .y, alt, heading, pitch, roll, f."),
        ("c.csv", f"{HEADER}\n", "No frame"),
        ("r.json", json.dumps(opensfm(projection_type="fisheye")), "of the type fisheye"),
        ("r.json", json.dumps(opensfm(focal_x=None)), "no focal length"),
        ("r.json", json.dumps(opensfm(width=-1)), "not a valid reconstruction.json"),
        ("r.json", json.dumps([{**opensfm()[1], "cameras": {}}]), "is not in the file"),
        ("r.json", "[]", "no reconstruction with a photo"),
        ("r.json", "[" * 3000, "not a valid reconstruction.json"),
        ("s.json", json.dumps(openmvg(lens={"fisheye": [0.1]})), "no pinhole"),
        ("s.json", json.dumps({**openmvg(), "extrinsics": []}), "no view with a pose"),
        ("s.json", json.dumps({**openmvg(), "intrinsics": []}), r"intrinsics of 1 views in .*\(a\.jpg\)"),
        ("s.json", '{"sfm_data_version": "0.3"}', "not a valid sfm_data.json"),
        ("cameras/a.json", json.dumps({**polycam(np.eye(3), CENTRE), "t_00": 3.0}), "no rigid motion"),
        ("cameras/a.json", "{}", r"not a valid camera of Polycam \(a\.json: fx: field .*t_03: field required and 8 more"),
    ],
)
def test_wrong_files_end_in_a_sentence(tmp_path: Path, name: str, text: str, message: str) -> None:
    """Models without an equal here, and damaged files."""
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    with pytest.raises(BadInputError, match=message) as caught:
        read(path if path.suffix in (".csv", ".json") and path.parent == tmp_path else path.parent)
    assert "\n" not in str(caught.value)


def test_all_that_is_missing_is_listed_up_to_ten(tmp_path: Path) -> None:
    """Fields, cameras and photos by name, then their number; the first alone would be mended twelve times."""
    names = [f"{k:02}.jpg" for k in range(12)]
    ten, whole = r"00.*01.*02.*03.*04.*05.*06.*07.*08.*09.*and 2 more", {name: SIZE for name in names}
    shots = opensfm()[1]["shots"]["a.jpg"]
    (tmp_path / "r.json").write_text(json.dumps([{**opensfm()[1], "shots": {name: shots | {"camera": "gone"} for name in names}}]))
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in names]
    (tmp_path / "t.json").write_text(json.dumps({"frames": frames}))
    (tmp_path / "u.json").write_text(json.dumps({"w": 600, "h": 400, "fl_x": 500, "frames": [{"file_path": name} for name in names]}))
    (tmp_path / "v.json").write_text(json.dumps({"w": 600, "h": 400, "fl_x": 500, "frames": frames}))
    (tmp_path / "xmp").mkdir()
    for name in names:
        position = '<x xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"><xcr:Position>1 2 3</xcr:Position></x>'
        (tmp_path / "xmp" / name.replace("jpg", "xmp")).write_text(position)
    for name, message in {
        "r.json": f"12 frames in .*camera that is not in the file .*{ten}",
        "t.json": f"12 frames in .*no focal length.*{ten}",
        "u.json": r"frames\.0\.transform_matrix: field required.*frames\.9\.transform_matrix: field required and 2 more",
        "xmp": r"lack fields \(00\.xmp: Rotation, 00\.xmp: FocalLength35mm, 01\.xmp.*04\.xmp: FocalLength35mm and 14 more",
    }.items():
        with pytest.raises(BadInputError, match=message):
            read_poses(tmp_path / name, [], whole)
    with pytest.raises(BadInputError, match=f"No frame in .*{ten}"):
        read_poses(tmp_path / "v.json", [], SIZES)
