"""The mesh stage from files to files: surfels laid on a torus, rendered by the real renderer, meshed, compared with the torus."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh

from gsbake.config.schema import Profile
from gsbake.geometry.cameras import CameraSet
from gsbake.pipeline.errors import BadInputError
from gsbake.stages.mesh import STAGE
from gsbake.surfels.model import create
from tests.meshing.scenes import cameras_around, gradient, torus, trace


class Run:
    """A context that records what the stage says."""

    def __init__(self, root: Path, **mesh: Any) -> None:
        self.out, self.checkpoint = root / "out", root / "checkpoint"
        for folder in (self.out, self.checkpoint):
            folder.mkdir(parents=True)
        self.inputs = {"poses": root.parent / "poses", "refine": root.parent / "refine"}
        profile = Profile()
        self.settings = profile.model_copy(
            update={"mesh": profile.mesh.model_copy(update=mesh), "train": profile.train.model_copy(update={"max_size": 120})}
        )
        self.seed, self.threads, self.device = 0, 2, "cpu"
        self.parts: list[str] = []
        self.decisions: dict[str, tuple[str, str]] = {}
        self.warnings: list[str] = []

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[None]:
        self.parts.append(name)
        yield

    def progress(self, done: int, total: int, text: str = "", **live: float) -> None:
        assert 0 < done <= total

    def stop_requested(self) -> bool:
        return False

    def check_stop(self) -> None:
        return

    def decide(self, what: str, choice: str, evidence: str, saved: float | None = None) -> None:
        self.decisions[what] = (choice, evidence)

    def warn(self, text: str) -> None:
        self.warnings.append(text)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("mesh")
    for folder in ("poses/photos", "poses/masks", "refine"):
        (root / folder).mkdir(parents=True)
    cameras = cameras_around((-40, 5, 50), 5, 160)
    CameraSet(tuple(cameras)).save(root / "poses" / "cameras.json")
    for camera in cameras:
        mask = np.where(trace(torus, camera)[0] > 0, 255, 0).astype(np.uint8)
        cv2.imwrite(str(root / "poses" / "masks" / f"{camera.name}.png"), mask)
        cv2.imwrite(str(root / "poses" / "photos" / f"{camera.name}.png"), np.repeat(mask[..., None], 3, 2))
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (9000, 3))
    for _ in range(12):
        points -= torus(points)[:, None] * gradient(torus, points)
    # Random points leave gaps at their mean spacing (0.023); discs nearly twice as wide cover them, as trained ones do.
    surfels = create(points, gradient(torus, points), np.full(len(points), 0.04), None, "colour", 0, 0.0, 4.0)
    surfels.save(root / "refine" / "surfels.safetensors")
    return root


@pytest.mark.parametrize("field", ["tsdf", "imls"])
def test_torus_comes_back(capture: Path, tmp_path: Path, field: str) -> None:
    run = Run(capture / f"run-{field}", field=field, faces=3000, max_resolution=80)
    results = STAGE.run(run)
    dense, low = (trimesh.load(run.out / name, process=False) for name in ("dense.ply", "mesh.ply"))
    assert results["dense_faces"] == len(dense.faces) and results["faces"] == len(low.faces) <= 3000
    for mesh in (dense, low):
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.euler_number == 0  # a torus
        assert np.abs(torus(np.asarray(mesh.vertices))).mean() < 0.4 * results["cell"]
        assert mesh.volume == pytest.approx(2 * np.pi**2 * 0.55 * 0.22**2, rel=0.04)
    assert results["components"] == 1 and results["watertight"]
    assert results["decimation_error_cells"] < 2 and not run.warnings
    assert {"field resolution", "truncation"} <= set(run.decisions)
    assert "surfel spacing" in run.decisions["field resolution"][1]
    assert not list(run.checkpoint.iterdir())  # nothing is left behind
    assert sorted(p.name for p in run.out.iterdir()) == ["dense.ply", "mesh.ply"]


@pytest.mark.parametrize("support", ["cut", "keep"])
def test_without_masks_the_table_is_left_out(tmp_path: Path, support: str) -> None:
    floor = -0.15
    for folder in ("poses/photos", "refine"):
        (tmp_path / folder).mkdir(parents=True)
    cameras = cameras_around((20, 50), 5, 160)
    CameraSet(tuple(cameras)).save(tmp_path / "poses" / "cameras.json")
    for camera in cameras:
        cv2.imwrite(str(tmp_path / "poses" / "photos" / f"{camera.name}.png"), np.full((camera.height, camera.width, 3), 90, np.uint8))
    rng = np.random.default_rng(0)
    body = rng.uniform(-0.9, 0.9, (9000, 3))
    for _ in range(12):
        body -= torus(body)[:, None] * gradient(torus, body)
    body = body[body[:, 2] > floor]
    angle, radius = rng.uniform(0, 2 * np.pi, 6000), np.sqrt(rng.uniform(0, 1, 6000))
    table = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(6000, floor)], 1)
    points = np.concatenate([body, table])
    normals = np.concatenate([gradient(torus, body), np.tile([0.0, 0.0, 1.0], (6000, 1))])
    create(points, normals, np.full(len(points), 0.04), None, "colour", 0, 0.0, 4.0).save(tmp_path / "refine" / "surfels.safetensors")
    run = Run(tmp_path / "run", faces=3000, max_resolution=80, support=support)
    results = STAGE.run(run)
    mesh = trimesh.load(run.out / "mesh.ply", process=False)
    across = np.linalg.norm(np.asarray(mesh.vertices)[:, :2], axis=1).max()
    if support == "keep":
        assert "support" not in run.decisions and across > 0.95
        return
    assert run.decisions["support"][0] == "left out"
    assert mesh.is_watertight and results["components"] == 1
    assert across == pytest.approx(0.77, abs=2 * results["cell"])
    assert mesh.bounds[0][2] == pytest.approx(floor, abs=results["cell"])
    assert mesh.bounds[1][2] == pytest.approx(0.22, abs=results["cell"])


def test_no_surfels_is_the_persons_error(capture: Path) -> None:
    from gsbake.surfels.model import Surfels

    run = Run(capture / "run-none")
    far = Surfels.load(capture / "refine" / "surfels.safetensors").select(torch.arange(20))
    far.position[:] = 5.0
    other = capture / "far"
    other.mkdir()
    far.save(other / "surfels.safetensors")
    run.inputs = run.inputs | {"refine": other}
    with pytest.raises(BadInputError, match="surfels"):
        STAGE.run(run)
