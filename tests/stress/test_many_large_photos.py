"""Memory of a capture of many large photos: every stage of `relight` with as many photos of 24 megapixels as GSBAKE_LARGE_PHOTOS says.

The photos are renders of the built-in object, enlarged. Settings that only cost time are small; those that memory depends on are the
profile's own. Beside it a mixed capture: portrait and landscape, 16-bit files, one photo much larger than the others.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.capture.full_photos import FullPhotos
from gsbake.synth.capture import write_capture

#: Number of photos, their edge in pixels, the edge of the renders, and most memory of a stage in bytes.
PHOTOS, EDGE, RENDERED, MOST_BYTES = int(os.environ.get("GSBAKE_LARGE_PHOTOS", "200")), 4900, 350, 4e9
STAGES = ("ingest", "poses", "stereo", "train", "refine", "mesh", "bake", "export", "report")
#: Fewer steps, and no rule that leaves out work, as it would here: enlarged photos have no detail.
QUICK = (
    "skip.resolution=keep", "skip.redundant_photos=keep", "train.iterations=60", "train.init_surfels=4000", "surfels.max_count=8000",
    "refine.iterations=20", "bake.fit_iterations=20", "bake.occlusion_rays=4", "report.views=2", "report.view_size=128",
)  # fmt: skip


def gsbake(*arguments: object) -> None:
    """The command line in a process of its own; it must succeed."""
    done = subprocess.run([sys.executable, "-m", "gsbake", *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"exit {done.returncode}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"


def run(command: str, capture: Path, out: Path, *settings: str) -> dict[str, dict[str, Any]]:
    """The manifests of all stages that a `command` runs with `relight`."""
    changes = [word for setting in settings for word in ("--set", setting)]
    gsbake(command, capture, "--out", out, "--profile", "relight", *changes)
    manifests = [json.loads(path.read_text(encoding="utf-8")) for path in out.glob("stages/*/*/manifest.json")]
    return {manifest["stage"]: manifest for manifest in manifests}


def enlarge(render: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Photo (h, w, 3) and mask (h, w) of a BGRA render; noise of a few levels, that does not compress away."""
    large = cv2.resize(render, (width, height), interpolation=cv2.INTER_CUBIC)
    tile = np.random.default_rng(0).integers(0, 4, (512, 512, 3), np.uint8)
    noise = np.tile(tile, (-(-height // 512), -(-width // 512), 1))[:height, :width]
    return cv2.add(np.ascontiguousarray(large[..., :3]), noise), np.where(large[..., 3] > 127, 255, 0).astype(np.uint8)


def rewrite_poses(capture: Path, intrinsics: list[dict[str, float]], names: list[str]) -> None:
    """Poses of the renders for the photos in `images/`, each with its own intrinsics."""
    document = json.loads((capture / "transforms.json").read_text(encoding="utf-8"))
    for frame, own, name in zip(document["frames"], intrinsics, names, strict=True):
        frame |= {"file_path": name} | own
    (capture / "transforms.json").write_text(json.dumps({"frames": document["frames"]}), encoding="utf-8")


def scaled(document: dict[str, Any], factor: float) -> dict[str, float]:
    """The shared intrinsics of a transforms.json for photos `factor` times as large."""
    return {key: factor * float(document[key]) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}


def renders(folder: Path, views: int, size: int) -> tuple[list[Path], dict[str, Any]]:
    """Renders of the built-in object moved aside, into `renders/`, and their poses."""
    write_capture(folder, views, size)
    (folder / "images").rename(folder / "renders")
    for name in ("images", "masks"):
        (folder / name).mkdir()
    return sorted((folder / "renders").iterdir()), json.loads((folder / "transforms.json").read_text(encoding="utf-8"))


@pytest.mark.stress
@pytest.mark.timeout(4 * 3600)
def test_memory_does_not_grow_with_the_number_of_photos(tmp_path: Path) -> None:
    """Every stage stays below 4 GB."""
    files, document = renders(tmp_path / "capture", PHOTOS, RENDERED)
    for file in files:
        photo, mask = enlarge(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), EDGE, EDGE)
        cv2.imwrite(str(tmp_path / "capture" / "images" / f"{file.stem}.jpg"), photo, [cv2.IMWRITE_JPEG_QUALITY, 80])
        cv2.imwrite(str(tmp_path / "capture" / "masks" / f"{file.stem}.png"), mask)
        file.unlink()
    rewrite_poses(tmp_path / "capture", [scaled(document, EDGE / RENDERED)] * len(files), [f"images/{file.stem}.jpg" for file in files])
    manifests = run("run", tmp_path / "capture", tmp_path / "out", *QUICK)
    assert manifests["ingest"]["results"]["photos"] == PHOTOS and set(STAGES) <= set(manifests)
    peaks = {stage: manifests[stage]["peak_bytes"] / 1e9 for stage in STAGES}
    print({stage: (round(peaks[stage], 2), round(manifests[stage]["seconds"])) for stage in STAGES})
    assert max(peaks.values()) * 1e9 <= MOST_BYTES, peaks


@pytest.mark.slow
def test_sizes_depths_and_formats_may_differ_in_one_capture(tmp_path: Path) -> None:
    """Ten photos of 1200 × 900 and 900 × 1200 as JPEG, 16-bit PNG and TIFF, and one of 100 megapixels: each is read at its own size."""
    files, document = renders(tmp_path / "capture", 11, 200)
    sizes = [(1200, 900), (900, 1200)] * 5 + [(11_600, 8700)]
    intrinsics, names = [], []
    for index, (file, (width, height)) in enumerate(zip(files, sizes, strict=True)):
        # The square render is enlarged to the shorter side and framed by black.
        edge = min(width, height)
        photo, mask = enlarge(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), edge, edge)
        left, top = (width - edge) // 2, (height - edge) // 2
        framed = [
            cv2.copyMakeBorder(part, top, height - edge - top, left, width - edge - left, cv2.BORDER_CONSTANT) for part in (photo, mask)
        ]
        kind = ("jpg", "png", "tif")[index % 3] if index < 10 else "jpg"
        picture = framed[0] if kind == "jpg" else framed[0].astype(np.uint16) * 257
        names.append(f"images/{file.stem}.{kind}")
        assert cv2.imwrite(str(tmp_path / "capture" / names[-1]), picture)
        assert cv2.imwrite(str(tmp_path / "capture" / "masks" / f"{file.stem}.png"), framed[1])
        own = scaled(document, edge / 200)
        intrinsics.append(own | {"cx": own["cx"] + left, "cy": own["cy"] + top, "w": float(width), "h": float(height)})
    rewrite_poses(tmp_path / "capture", intrinsics, names)
    small = "ingest.max_size=300", "skip.resolution=keep", "skip.redundant_photos=keep"
    manifests = run("poses", tmp_path / "capture", tmp_path / "out", *small)
    assert manifests["ingest"]["results"]["photos"] == manifests["poses"]["results"]["registered"] == 11
    assert max(manifest["peak_bytes"] for manifest in manifests.values()) < 2.5e9
    folders = [next(path.parent for path in (tmp_path / "out").glob(f"stages/{stage}/*/manifest.json")) for stage in ("ingest", "poses")]
    with FullPhotos(*folders) as photos:
        assert [(photos.camera(index).width, photos.camera(index).height) for index in range(11)] == sizes
        for index, file in enumerate(files[:3]):
            render = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            view = photos.view(index, 300)
            edge = min(view.rgb.shape[:2])
            middle = view.rgb[(view.rgb.shape[0] - edge) // 2 :, (view.rgb.shape[1] - edge) // 2 :][:edge, :edge]
            true = cv2.resize(render[..., 2::-1], (edge, edge), interpolation=cv2.INTER_CUBIC)
            inside = cv2.erode((cv2.resize(render[..., 3], (edge, edge)) > 250).astype(np.uint8), np.ones((5, 5))) > 0
            assert np.abs(middle.astype(float) - true - 1.5)[inside].mean() < 4, names[index]
        assert photos.view(10).rgb.shape == (8700, 11_600, 3)
