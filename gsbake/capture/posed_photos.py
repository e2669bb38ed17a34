"""Posed photos of a capture as the poses stage writes them: cameras, undistorted photos and masks, tie points.

Photos are read from disk one by one and stay 8-bit, so that memory does not grow with the number of photos.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.photos.replaced import require_sizes
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.geometry.region import Region

Bytes = NDArray[np.uint8]

#: File of the box outside of which nothing is baked, in the cameras' frame.
REGION = "region.json"
#: File of the digests of the photos, by name.
DIGESTS = "photo_digests.json"


@dataclass(frozen=True)
class View:
    """One photo at a working size: `rgb` (h, w, 3) 8-bit sRGB, `mask` (h, w) 8-bit or None, and its camera."""

    camera: Camera
    rgb: Bytes
    mask: Bytes | None


@dataclass(frozen=True)
class PosedPhotos:
    """Artifact folder of the poses stage. Cameras are in the unit frame."""

    folder: Path
    cameras: CameraSet

    @staticmethod
    def open(folder: Path, trained: Path | None = None) -> PosedPhotos:
        """Open the artifact folder of the poses stage.

        Cameras are read from `trained`, the folder of the train or refine stage, if training refined them, else from `folder`. Every stage
        after training has to pass `trained`, so that all of them use the same cameras. Raises BadInputError for photos and masks that were
        replaced by those of another size.
        """
        refined = None if trained is None else trained / "cameras.json"
        cameras = CameraSet.load(folder / "cameras.json" if refined is None or not refined.exists() else refined)
        require_sizes(folder, {camera.name: (camera.width, camera.height) for camera in cameras.cameras}, "poses")
        return PosedPhotos(folder, cameras)

    def __len__(self) -> int:
        return len(self.cameras.cameras)

    @property
    def has_masks(self) -> bool:
        """Whether every photo has a mask."""
        return all(self._mask_file(c).exists() for c in self.cameras.cameras)

    @property
    def region(self) -> Region | None:
        """The box outside of which nothing is baked, in the unit frame; None without one."""
        path = self.folder / REGION
        return Region.read(path).moved(self.cameras.to_world.inverse()) if path.exists() else None

    def view(self, index: int, max_size: int | None = None) -> View:
        """Photo, mask and camera `index`, the longer side at most `max_size` pixels (area filter)."""
        import cv2

        camera = self.cameras.cameras[index]
        bgr = cv2.imread(str(self.folder / "photos" / f"{camera.name}.png"), cv2.IMREAD_COLOR)
        if bgr is None:
            raise FileNotFoundError(f"{self.folder / 'photos' / camera.name}.png")
        rgb = bgr[..., ::-1]
        reduced, mask = self.mask(index, max_size)
        if reduced is not camera:
            rgb = cv2.resize(rgb, (reduced.width, reduced.height), interpolation=cv2.INTER_AREA)
        return View(reduced, np.ascontiguousarray(rgb, np.uint8), mask)

    def mask(self, index: int, max_size: int | None = None) -> tuple[Camera, Bytes | None]:
        """Camera and mask (h, w) `index`, the mask None where there is none; the longer side at most `max_size` pixels (area filter)."""
        import cv2

        camera = self.cameras.cameras[index]
        path = self._mask_file(camera)
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.exists() else None
        reduced = camera if max_size is None else camera.downscaled_to(max_size)
        if reduced is not camera and mask is not None:
            mask = cv2.resize(mask, (reduced.width, reduced.height), interpolation=cv2.INTER_AREA)
        return reduced, None if mask is None else np.ascontiguousarray(mask, np.uint8)

    def points(self) -> tuple[NDArray[np.float64], Bytes] | None:
        """Tie points (n, 3) in the unit frame and their colours (n, 3) 8-bit, or None when there are none."""
        path = self.folder / "points.ply"
        if not path.exists():
            return None
        from gsbake.geometry.ply import read_cloud

        return read_cloud(path)

    def _mask_file(self, camera: Camera) -> Path:
        return self.folder / "masks" / f"{camera.name}.png"
