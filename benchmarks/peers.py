"""Other photogrammetry tools on the same captures: run where they are installed, or quoted from a published table.

pyarchinit-photogrammetry runs through the scorer's `peer_ppg.py` in a separate virtual environment, $GSBAKE_PEER or ./.peer:

    python3.11 -m venv .peer && .peer/bin/pip install "pyarchinit-photogrammetry[mesh,fast]"

OpenMVS (2.2 or later) runs where its five programs are on the PATH. It receives the undistorted cameras and tie points of gsbake's poses
stage (pycolmap) and the same masks; their seconds count. A tool that is not installed has no row; one that produces no mesh has a row
without figures.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from benchmarks.rows import Row
from benchmarks.truth import Array, Figures, measure_aligned, measure_file, read_mesh, read_truth
from gsbake.errors import UsageError

ROOT = Path(__file__).resolve().parents[1]
PEER = Path(os.environ.get("GSBAKE_PEER", ROOT / ".peer"))
SCRIPT = Path(os.environ.get("GSBAKE_SCORE", ROOT.parent / "shared" / "score")) / "peer_ppg.py"
PYARCHINIT = "pyarchinit-photogrammetry"
OPENMVS = ("InterfaceCOLMAP", "DensifyPointCloud", "ReconstructMesh", "RefineMesh", "TextureMesh")
#: Time limit of a program in seconds.
TIMEOUT_SECONDS = 3600

#: When the quoted rows were taken over.
QUOTED_ON = "2026-11-21"
#: From the scorer's README: two idle cores, the same photos and true masks, structure from motion and texturing included. Neither tool
#: produced a mesh of boombox.
QUOTED = (
    Row("avocado", "OpenMVS 2.3", "", "", None, 132.0, 0.119, 0.986, 6.8, source="quoted", date=QUOTED_ON),
    Row("avocado", "OpenMVS 2.3", "", "", None, 83.0, 0.14, None, 6.5, source="quoted", date=QUOTED_ON),
    Row("avocado", f"{PYARCHINIT} 1.6", "", "", None, 105.0, 0.41, 0.902, 30.0, source="quoted", date=QUOTED_ON),
)


def run_program(command: Sequence[str | Path], folder: Path, **environment: str) -> tuple[bool, float]:
    """Run a program in `folder` with its output in `<program>.log` there; returns success and wall seconds."""
    start = time.perf_counter()
    with (folder / f"{Path(command[0]).name}.log").open("wb") as log:
        try:
            done = subprocess.run(
                [str(c) for c in command],
                cwd=folder,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=os.environ | environment,
                timeout=TIMEOUT_SECONDS,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return False, time.perf_counter() - start
    return done.returncode == 0, time.perf_counter() - start


def fresh(folder: Path) -> Path:
    """Create the folder, or empty it; returns its absolute path."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder.resolve()


def run_pyarchinit(name: str, capture: Path, out: Path) -> list[Row]:
    """Bake a capture with pyarchinit-photogrammetry into `out`; no row where it or its script is missing.

    Seconds are those it reports for its steps up to the mesh, without texturing.
    """
    python = PEER.resolve() / "bin" / "python"
    if not (python.is_file() and SCRIPT.is_file()):
        return []
    code = f"import importlib.metadata as m; print(m.version({PYARCHINIT!r}))"
    version = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False)
    if version.returncode:
        return []
    folder = fresh(out)
    done, spent = run_program([python, SCRIPT.resolve(), capture.resolve(), folder], folder, PPG_GPU="off")
    tool = f"{PYARCHINIT} {version.stdout.strip()}"
    if not done:
        return [Row(name, tool, "", "", None, spent)]
    times = json.loads((folder / "times.json").read_text())
    row = Row(name, tool, "", "", None, times["total"] - times["texture"])
    return [with_figures(row, lambda: measure_file(folder / "asset.glb", capture, folder / "cameras.json"))]


def with_figures(row: Row, measured: Callable[[], Figures]) -> Row:
    """The row with the figures of its mesh, or unchanged, with a message, without a mesh."""
    try:
        return row.with_figures(measured())
    except UsageError as error:
        sys.stdout.write(f"{row.capture}, {row.tool}: {error}\n")
        return row


def has_openmvs() -> bool:
    """Whether all programs of OpenMVS are on the PATH."""
    return all(shutil.which(program) for program in OPENMVS)


def prepare_openmvs(stages: Mapping[str, Path], folder: Path) -> dict[str, Array]:
    """Undistorted photos, masks and the sparse model as text below `folder`; returns the camera centres (3,) by photo name.

    `stages` has the folders of ingest (photos, masks) and poses (sparse model).
    """
    import pycolmap

    photos, masks = stages["ingest"] / "photos", stages["ingest"] / "masks"
    pycolmap.logging.minloglevel = 2  # errors only
    pycolmap.undistort_images(str(folder), str(stages["poses"] / "sparse"), str(photos))
    model = pycolmap.Reconstruction(str(folder / "sparse"))
    model.write_text(str(folder / "sparse"))
    distorted = pycolmap.Reconstruction(str(stages["poses"] / "sparse"))
    (folder / "masks").mkdir()
    centres: dict[str, Array] = {}
    for image in distorted.images.values():
        stem = Path(image.name).stem
        centres[stem] = image.projection_center()
        mask = pycolmap.Bitmap.read(str(masks / f"{stem}.png"), as_rgb=False) if (masks / f"{stem}.png").is_file() else None
        if mask is not None:
            flat, _ = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), mask, distorted.cameras[image.camera_id])
            flat.write(str(folder / "masks" / f"{stem}.mask.png"))
    return centres


def run_openmvs(name: str, capture: Path, stages: Mapping[str, Path], before: float, out: Path, threads: int) -> list[Row]:
    """Dense points, mesh, refined mesh and texture with OpenMVS; a row after every program that writes a mesh.

    `stages` as for `prepare_openmvs`; `before`: their seconds. When a program fails or its mesh is empty, the last row has no figures.
    """
    folder, truth = fresh(out), read_truth(capture)
    start = time.perf_counter()
    centres = prepare_openmvs(stages, folder)
    spent = before + time.perf_counter() - start
    masked = ["--mask-path", "masks", "--ignore-mask-label", "0"] if any((folder / "masks").iterdir()) else []
    limit = ["--max-threads", str(threads)]
    calls: list[tuple[list[str], str | None]] = [
        (["InterfaceCOLMAP", "-i", ".", "-o", "scene.mvs", "--image-folder", "images/"], None),
        (["DensifyPointCloud", "scene.mvs", "-o", "dense.mvs", *masked], None),
        (["ReconstructMesh", "dense.mvs", "-p", "dense.ply", "-o", "mesh.mvs"], "mesh.ply"),
        (["RefineMesh", "dense.mvs", "-m", "mesh.ply", "-o", "refined.mvs"], "refined.ply"),
        (["TextureMesh", "dense.mvs", "-m", "refined.ply", "-o", "textured.mvs"], "textured.ply"),
    ]

    def measure_mesh(mesh: str) -> Figures:
        return measure_aligned(read_mesh(folder / mesh), centres, truth)

    rows: list[Row] = []
    for call, mesh in calls:
        done, seconds = run_program([*call, *limit], folder)
        spent += seconds
        row = Row(name, "OpenMVS", "", "", None, spent)
        if not done:
            return [*rows, row]
        if mesh is None:
            continue
        rows.append(with_figures(row, partial(measure_mesh, mesh)))
        if rows[-1].chamfer_pct is None:  # the next program would start from that mesh
            break
    return rows
