"""Pose files of strangers: transforms.json, OpenSfM, OpenMVG, Polycam, Metashape XML, RealityScan, LLFF, COLMAP text and binary."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from gsbake.capture.poses.colmap_model import model_reader, read_model_with
from gsbake.capture.poses.frames import GivenPoses, PhotoSize
from gsbake.capture.poses.given import read_poses
from gsbake.errors import BadInputError
from gsbake.limited_process import ParserProcess
from tests.fuzz.harness import damaged, edges, fuzz, json_values, numbers_of_bytes, odd_floats, odd_text, outcome, replaced_values

SIZES = {"a.jpg": PhotoSize(200, 100), "b.jpg": PhotoSize(100, 200, 6)}
POSE = np.eye(4).tolist()
FRAMES = [{"file_path": "images/a.jpg", "transform_matrix": POSE}, {"file_path": "b", "transform_matrix": POSE, "fl_x": 90.0, "k1": 0.1}]
TRANSFORMS = {
    "camera_model": "OPENCV", "fl_x": 150.0, "fl_y": 151.0, "cx": 100.0, "cy": 50.0, "w": 200, "h": 100, "k1": 0.01, "k2": 0.0, "p1": 0.0,
    "camera_angle_x": 1.0, "is_fisheye": False, "frames": FRAMES,
}  # fmt: skip


def check_poses(given: GivenPoses | None) -> GivenPoses | None:
    """Every camera that was read is finite, has pixels and belongs to a photo."""
    for name, camera in {} if given is None else given.cameras.items():
        numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion, *camera.R.ravel(), *camera.t]
        assert name in SIZES and np.isfinite(numbers).all() and min(camera.width, camera.height) >= 1 and min(camera.fx, camera.fy) > 0
        assert np.allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-6)
    if given is not None and given.points is not None:
        assert np.isfinite(given.points).all() and given.colours is not None and len(given.points) == len(given.colours)
    return given


def test_transforms(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "transforms.json"

    def check(data: bytes) -> GivenPoses | None:
        path.write_bytes(data)
        return check_poses(outcome(lambda: read_poses(path, list(SIZES), SIZES), BadInputError))

    documents = replaced_values(TRANSFORMS).map(lambda body: json.dumps(body).encode())
    fuzz(capsys, "transforms.json", st.one_of(documents, damaged([json.dumps(TRANSFORMS).encode(), b"[" * 5000, b"{}"])), check)


LENS = {"projection_type": "brown", "width": 200, "height": 100, "focal_x": 0.8, "focal_y": 0.8, "c_x": 0.0, "k1": 0.01, "p1": 0.0}
OPENSFM = [{
    "cameras": {"lens": LENS},
    "shots": {"a.jpg": {"rotation": [0.1, 0.2, 0.3], "translation": [1.0, 2.0, 3.0], "camera": "lens"}},
    "points": {"1": {"coordinates": [1.0, 2.0, 3.0], "color": [1, 2, 3]}},
}]  # fmt: skip
VIEW = {"filename": "a.jpg", "local_path": "", "id_intrinsic": 0, "id_pose": 0}
PINHOLE = {"width": 200, "height": 100, "focal_length": 150.0, "principal_point": [100.0, 50.0]}
OPENMVG = {
    "sfm_data_version": "0.3",
    "views": [{"key": 0, "value": {"ptr_wrapper": {"data": VIEW}}}],
    "intrinsics": [{"key": 0, "value": {"ptr_wrapper": {"data": {"value0": PINHOLE, "disto_k3": [0.1, 0.0, 0.0]}}}}],
    "extrinsics": [{"key": 0, "value": {"rotation": np.eye(3).tolist(), "center": [1.0, 2.0, 3.0]}}],
}
POLYCAM = {
    "fx": 150.0, "fy": 150.0, "cx": 100.0, "cy": 50.0, "width": 200, "height": 100,
    **{f"t_{i}{j}": float(i == j) for i in range(3) for j in range(4)},
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "body"), [("reconstruction.json", OPENSFM), ("sfm_data.json", OPENMVG), ("cameras/a.json", POLYCAM)]
)
def test_json_of_other_programs(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, body: Any) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    poses = path.parent if path.parent != tmp_path else path

    def check(data: bytes) -> GivenPoses | None:
        path.write_bytes(data)
        return check_poses(outcome(lambda: read_poses(poses, list(SIZES), SIZES), BadInputError))

    assert check(json.dumps(body).encode()) is not None
    documents = replaced_values(body).map(lambda changed: json.dumps(changed).encode())
    fuzz(capsys, name, st.one_of(documents, damaged([json.dumps(body).encode(), b"[" * 5000, b"{}"])), check)


REALITY_SCAN = {
    "c.csv": b"#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\na.jpg,1,2,3,10,20,30,42,0.01,0,0.01,0,0,0,0,0\n",
    "a.xmp": (
        b'<x xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:FocalLength35mm="42" xcr:DistortionModel="brown3">'
        b"<xcr:Rotation>1 0 0 0 1 0 0 0 1</xcr:Rotation><xcr:Position>1 2 3</xcr:Position>"
        b"<xcr:DistortionCoeficients>0.01 0 0 0 0 0</xcr:DistortionCoeficients></x>"
    ),
}


@pytest.mark.parametrize("name", REALITY_SCAN)
def test_reality_scan(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    path, content = tmp_path / name, REALITY_SCAN[name]

    def check(data: bytes) -> GivenPoses | None:
        path.write_bytes(data)
        poses = path if path.suffix == ".csv" else tmp_path
        return check_poses(outcome(lambda: read_poses(poses, list(SIZES), SIZES), BadInputError))

    assert check(content) is not None
    numbers = st.tuples(st.sampled_from([b"42", b"0.01", b"1", b"2", b"3"]), odd_floats.map(lambda x: repr(x).encode()))
    replaced = numbers.map(lambda pair: content.replace(pair[0], pair[1]))
    fuzz(capsys, f"RealityScan {name}", st.one_of(replaced, damaged([content, b"", b"<a>" * 5000])), check)


METASHAPE = (
    b'<document><chunk><sensors><sensor id="0" type="frame"><calibration type="frame"><resolution width="200" height="100"/>'
    b"<f>150</f><cx>1</cx><k1>0.01</k1><p1>0</p1><b1>0</b1></calibration></sensor></sensors><cameras>"
    b'<camera label="a.jpg" sensor_id="0"><transform>1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1</transform></camera></cameras>'
    b"<transform><scale>1</scale></transform></chunk></document>"
)


def test_metashape(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cameras.xml"

    def check(data: bytes) -> GivenPoses | None:
        path.write_bytes(data)
        return check_poses(outcome(lambda: read_poses(path, list(SIZES), SIZES), BadInputError))

    numbers = st.tuples(st.sampled_from([b"150", b"200", b"0.01", b"1 0 0 1", b"<scale>1"]), odd_floats.map(lambda x: repr(x).encode()))
    replaced = numbers.map(lambda pair: METASHAPE.replace(pair[0], b"<scale>" + pair[1] if pair[0][:1] == b"<" else pair[1]))
    fuzz(capsys, "Metashape XML", st.one_of(replaced, damaged([METASHAPE, b"<document/>", b"<a>" * 5000])), check)


def npy(rows: np.ndarray[Any, Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, rows)
    return file.getvalue()


def row(translation: float = 0.0, size: tuple[float, float] = (100.0, 200.0), focal: float = 150.0) -> list[float]:
    """One LLFF row: axes down, right, back."""
    down, right, back, centre = [0, -1, 0], [1, 0, 0], [0, 0, 1], [translation] * 3
    matrix = np.array([down, right, back, centre, [*size, focal]], float).T
    return [*matrix.ravel().tolist(), 1.0, 5.0]


def headers() -> st.SearchStrategy[bytes]:
    """Hand-made headers of .npy files, with shapes, types and orders that no array has."""
    fields = st.fixed_dictionaries({
        "descr": st.one_of(st.sampled_from(["<f8", "<f4", "|O", "<U4", "|V8", "<M8[s]", ">i2", "|b1", "<c16"]), json_values),
        "fortran_order": st.one_of(st.booleans(), json_values),
        "shape": st.one_of(st.tuples(edges, edges), st.lists(edges, max_size=3), json_values),
    })  # fmt: skip
    text = st.one_of(fields.map(repr), st.text(max_size=60), st.sampled_from(["(" * 3000, "{" * 200, "1" * 6000, "__import__('os')"]))

    def build(header: str, version: int, data: bytes) -> bytes:
        raw = header.encode("utf-8", "surrogatepass") + b"\n"
        return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", len(raw) & 0xFFFF) + raw + data

    return st.builds(build, text, st.integers(0, 4), st.binary(max_size=300))


def test_llff(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "poses_bounds.npy"

    def check(data: bytes) -> GivenPoses | None:
        path.write_bytes(data)
        return check_poses(outcome(lambda: read_poses(path, list(SIZES), SIZES), BadInputError))

    good = [row(), row(1.0, (200.0, 100.0))]
    seeds = [
        npy(np.array(good)),
        npy(np.array(good, np.float32)),
        npy(np.asfortranarray(good)),
        npy(np.array(good, np.int64)),
        b"PK\x03\x04",
    ]
    numbers = st.lists(st.lists(st.one_of(odd_floats, st.floats()), min_size=17, max_size=17), min_size=2, max_size=2)
    arrays = numbers.map(lambda rows: npy(np.array(rows)))
    fuzz(capsys, "poses_bounds.npy", st.one_of(damaged(seeds), arrays, headers()), check)


def binary_model() -> dict[str, bytes]:
    """A COLMAP model of two cameras, two images and two points."""
    cameras = struct.pack("<Q", 2)
    cameras += struct.pack("<IiQQ4d", 1, 1, 200, 100, 150.0, 150.0, 100.0, 50.0) + struct.pack(
        "<IiQQ4d", 2, 2, 100, 200, 90.0, 50.0, 100.0, 0.1
    )
    images = struct.pack("<Q", 2)
    for number, name in ((1, b"a.jpg"), (2, b"b.jpg")):
        images += struct.pack("<I7dI", number, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3, number) + name + b"\0"
        images += struct.pack("<Q", 2) + struct.pack("<ddq", 10.0, 20.0, 1) + struct.pack("<ddq", 30.0, 40.0, 2)
    points = struct.pack("<Q", 2)
    for number in (1, 2):
        points += struct.pack("<Q3d3Bd", number, 0.0, 0.1, 1.0, 255, 0, 9, 0.5) + struct.pack("<Q", 2)
        points += struct.pack("<4I", 1, number - 1, 2, number - 1)
    return {"cameras.bin": cameras, "images.bin": images, "points3D.bin": points}


TEXT_MODEL = {
    "cameras.txt": b"# cameras\n1 PINHOLE 200 100 150 150 100 50\n2 SIMPLE_RADIAL 100 200 90 50 100 0.1\n",
    "images.txt": b"# images\n1 1 0 0 0 0.1 0.2 0.3 1 a.jpg\n10 20 1 30 40 2\n2 1 0 0 0 0.1 0.2 0.3 2 b.jpg\n10 20 1 30 40 2\n",
    "points3D.txt": b"# points\n1 0 0.1 1 255 0 9 0.5 1 0 2 0\n2 0 0.1 1 255 0 9 0.5 1 1 2 1\n",
}


@pytest.fixture
def reader() -> Iterator[ParserProcess]:
    with model_reader() as process:
        yield process


def fuzz_models(
    capsys: pytest.CaptureFixture[str],
    title: str,
    folder: Path,
    reader: ParserProcess,
    files: dict[str, bytes],
    inputs: st.SearchStrategy[Any],
) -> None:
    """Inputs are {file: its bytes}, laid over the good `files`; None for a missing file."""
    folder.mkdir()

    def check(changed: dict[str, bytes | None]) -> GivenPoses | None:
        for name, data in {**files, **changed}.items():
            (folder / name).unlink(missing_ok=True)
            if data is not None:
                (folder / name).write_bytes(data)
        return check_poses(outcome(lambda: read_model_with(reader, folder, SIZES), BadInputError))

    assert check({}) is not None
    fuzz(capsys, title, inputs, check)


def test_colmap_binary(tmp_path: Path, reader: ParserProcess, capsys: pytest.CaptureFixture[str]) -> None:
    files = binary_model()
    inputs = st.sampled_from(sorted(files)).flatmap(
        lambda name: st.one_of(damaged([files[name]], 3), numbers_of_bytes(), st.none()).map(lambda data: {name: data})
    )
    fuzz_models(capsys, "COLMAP binary", tmp_path / "sparse", reader, files, inputs)


def test_colmap_text(tmp_path: Path, reader: ParserProcess, capsys: pytest.CaptureFixture[str]) -> None:
    words = st.one_of(
        edges.map(str), odd_floats.map(str), odd_text, st.sampled_from(["OPENCV_FISHEYE", "FULL_OPENCV", "-1", "a.jpg", "\t", "#"])
    )

    @st.composite
    def texts(draw: st.DrawFn) -> dict[str, bytes | None]:
        name = draw(st.sampled_from(sorted(TEXT_MODEL)))
        if draw(st.booleans()):
            return {name: draw(st.one_of(damaged([TEXT_MODEL[name]], 3), st.none()))}
        lines = [line.split(b" ") for line in TEXT_MODEL[name].split(b"\n")]
        for _ in range(draw(st.integers(1, 3))):
            line = lines[draw(st.integers(0, len(lines) - 1))]
            line[draw(st.integers(0, len(line) - 1))] = draw(words).encode("utf-8", "surrogateescape")
        return {name: b"\n".join(b" ".join(line) for line in lines)}

    fuzz_models(capsys, "COLMAP text", tmp_path / "sparse", reader, TEXT_MODEL, texts())
