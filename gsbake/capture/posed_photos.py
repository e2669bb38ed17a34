"""The posed photos of one capture, as the poses stage leaves them: cameras, undistorted photos and masks, SfM points.

Photos stay on disk (or as 8-bit arrays at the size asked for): a set of large photos never becomes floats at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera, CameraSet

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class View:
    """One photo at a working size: `rgb` (h, w, 3) 8-bit sRGB, `mask` (h, w) 8-bit or None, and its camera."""

    camera: Camera
    rgb: Bytes
    mask: Bytes | None


@dataclass(frozen=True)
class PosedPhotos:
    """Folder of the poses stage, opened. Cameras live in the unit frame."""

    folder: Path
    cameras: CameraSet

    @staticmethod
    def open(folder: Path, trained: Path | None = None) -> PosedPhotos:
        """Open the artifact folder of the poses stage, with the cameras in force.

        These are the ones that training refined, if the folder of the train or refine stage, `trained`, holds any; else those of the poses
        stage. Every stage after training has to pass that folder, so that all of them see the same cameras.
        """
        refined = None if trained is None else trained / "cameras.json"
        return PosedPhotos(folder, CameraSet.load(folder / "cameras.json" if refined is None or not refined.exists() else refined))

    def __len__(self) -> int:
        return len(self.cameras.cameras)

    @property
    def has_masks(self) -> bool:
        """Whether every photo has a mask."""
        return all((self.folder / "masks" / f"{c.name}.png").exists() for c in self.cameras.cameras)

    def view(self, index: int, max_size: int | None = None) -> View:
        """Photo `index` with the longer side at most `max_size` pixels (area filter), and its camera to match."""
        import cv2

        camera = self.cameras.cameras[index]
        bgr = cv2.imread(str(self.folder / "photos" / f"{camera.name}.png"), cv2.IMREAD_COLOR)
        if bgr is None:
            raise FileNotFoundError(f"{self.folder / 'photos' / camera.name}.png")
        rgb = bgr[..., ::-1]
        mask_file = self.folder / "masks" / f"{camera.name}.png"
        mask = cv2.imread(str(mask_file), cv2.IMREAD_GRAYSCALE) if mask_file.exists() else None
        reduced = camera if max_size is None else camera.within(max_size)
        if reduced is not camera:
            camera, size = reduced, (reduced.width, reduced.height)
            rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
            if mask is not None:
                mask = cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
        return View(
            camera, np.ascontiguousarray(rgb, np.uint8), None if mask is None else np.ascontiguousarray(mask, np.uint8)
        )

    def mask(self, index: int, max_size: int | None = None) -> tuple[Camera, Bytes | None]:
        """Camera and mask `index` (h, w), or None for the latter, with the longer side at most `max_size` (area filter); reads no photo."""
        import cv2

        camera = self.cameras.cameras[index]
        path = self.folder / "masks" / f"{camera.name}.png"
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.exists() else None
        longer = max(camera.width, camera.height)
        if max_size is not None and longer > max_size:
            camera = camera.scaled(max(1, round(camera.width * max_size / longer)), max(1, round(camera.height * max_size / longer)))
            if mask is not None:
                mask = cv2.resize(mask, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        return camera, None if mask is None else np.ascontiguousarray(mask, np.uint8)

    def points(self) -> tuple[NDArray[np.float64], Bytes] | None:
        """SfM points (n, 3) in the unit frame and their colours (n, 3), or None when there are none."""
        path = self.folder / "points.ply"
        if not path.exists():
            return None
        from gsbake.geometry.ply import read_cloud

        return read_cloud(path)
