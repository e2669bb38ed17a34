"""Posed photos at full size: the originals that the ingest stage kept, undistorted as the poses stage undistorted its working photos.

A photo without an original (it is no larger than its working photo), and one whose working photo was replaced by hand, is read as
`PosedPhotos` reads it. So are reduced photos that are no larger than the working ones.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.exposure import written_exposures
from gsbake.capture.photos.conversion import file_digest
from gsbake.capture.photos.originals import Originals, changed_pixels
from gsbake.capture.photos.undistortion import intrinsics_key, pinhole_camera, undistorted
from gsbake.capture.posed_photos import DIGESTS, Bytes, PosedPhotos, View
from gsbake.geometry.cameras import Camera, CameraSet

#: Pixels of all photos together at a size above the least one: memory and time of stereo grow with them.
MAX_TOTAL_PIXELS = 100e6


class FullPhotos:
    """Photos of the poses stage by index, with the cameras of `posed`, read from the originals of the ingest stage; a context manager that
    ends the processes that decode."""

    def __init__(self, ingest: Path | None, poses: Path, trained: Path | None = None, readers: int = 1) -> None:
        """Open artifact folders of the ingest and the poses stage; `trained` as in `PosedPhotos.open`. Without `ingest` there are no
        originals. `readers` photos are decoded at a time."""
        self.posed = PosedPhotos.open(poses, trained)
        self._originals = Originals(ingest, readers)
        self._lenses, self._pinholes = self._pairs(poses)

    def __enter__(self) -> FullPhotos:
        return self

    def __exit__(self, *_: object) -> None:
        self._originals.close()

    def __len__(self) -> int:
        return len(self.posed)

    def _pairs(self, poses: Path) -> tuple[dict[str, Camera], dict[str, Camera]]:
        """By name, the cameras of originals at full size: with their lens, and the pinhole cameras that they were undistorted to, in whose
        place training or the user may have put others."""
        lens_file, digest_file = poses / "photo_cameras.json", poses / DIGESTS
        if not (lens_file.exists() and digest_file.exists()):
            return {}, {}
        digests = json.loads(digest_file.read_text(encoding="utf-8"))
        working = {camera.name: camera for camera in CameraSet.load(lens_file).cameras}
        lenses, pinholes = {}, {}
        known: dict[tuple[float, ...], Camera] = {}
        for camera in CameraSet.load(poses / "cameras.json").cameras:
            name = camera.name
            photo = poses / "photos" / f"{name}.png"
            if name not in working or not self._originals.has(name) or file_digest(photo) != digests.get(name):
                continue
            lens, (width, height) = working[name], self._originals.size(name)
            pinhole = known.get(intrinsics_key(lens)) or known.setdefault(intrinsics_key(lens), pinhole_camera(lens))
            if (pinhole.width, pinhole.height) != (camera.width, camera.height):
                continue
            lenses[name] = lens.scaled(width, height)
            pinholes[name] = pinhole.scaled(round(camera.width * width / lens.width), round(camera.height * height / lens.height))
        return lenses, pinholes

    def written_exposures(self) -> NDArray[np.float64] | None:
        """Logarithms (photos,) of their exposures by EXIF, of mean 0 (`capture.exposure.written_exposures`)."""
        return written_exposures(self._originals.entries([camera.name for camera in self.posed.cameras.cameras]))

    def size_of(self, least: int, share: float) -> int:
        """Longer side in pixels of this `share` of the photos' full size, in the median; less where all together would have more than
        MAX_TOTAL_PIXELS; at least `least`."""
        cameras = [self.camera(index) for index in range(len(self))]
        shared = share * float(np.median([max(c.width, c.height) for c in cameras]))
        area = sum(min(c.width, c.height) / max(c.width, c.height) for c in cameras)
        return max(least, round(min(shared, (MAX_TOTAL_PIXELS / area) ** 0.5)))

    def camera(self, index: int, max_size: int | None = None) -> Camera:
        """Pinhole camera `index` of the photo at full size, or with the longer side at most `max_size` pixels."""
        camera = self.posed.cameras.cameras[index]
        pinhole = self._pinholes.get(camera.name)
        full = camera if pinhole is None else camera.scaled(pinhole.width, pinhole.height)
        return full if max_size is None else full.downscaled_to(max_size)

    def view(self, index: int, max_size: int | None = None) -> View:
        """Photo, mask and camera `index`, undistorted, the longer side at most `max_size` pixels (area filter in linear light).

        Raises BadInputError when the original cannot be read, InterruptedRun when the process that decodes it is killed.
        """
        camera, working = self.camera(index, max_size), self.posed.cameras.cameras[index]
        if max(camera.width, camera.height) <= max(working.width, working.height):
            return self.posed.view(index, max_size)
        lens, pinhole = self._lenses[camera.name], self._pinholes[camera.name]
        share = max(camera.width / pinhole.width, camera.height / pinhole.height)
        lens = lens.downscaled_to(round(share * max(lens.width, lens.height)))
        pinhole = pinhole.scaled(camera.width, camera.height)
        rgb = self._originals.read(camera.name, max(lens.width, lens.height))
        if lens.distortion or rgb.shape[:2] != (pinhole.height, pinhole.width):
            rgb = undistorted(rgb, lens.scaled(rgb.shape[1], rgb.shape[0]), pinhole)
        return View(camera, rgb, self._mask(index, lens, pinhole))

    def _mask(self, index: int, lens: Camera, pinhole: Camera) -> Bytes | None:
        """The mask at the size of `pinhole`: the given one where the working mask, which poses may have changed, agrees with it."""
        _, working = self.posed.mask(index)
        if working is None:
            return None
        size = pinhole.width, pinhole.height
        full = self._originals.mask(pinhole.name, (lens.width, lens.height))
        if full is None:
            return np.asarray(cv2.resize(working, size, interpolation=cv2.INTER_LINEAR), np.uint8)
        if lens.distortion or full.shape != (pinhole.height, pinhole.width):
            full = undistorted(full, lens, pinhole, mask=True)
        changed = changed_pixels(full, working)
        if not changed.any():
            return full
        # With the pixels that the edge of the change shares.
        enlarged = cv2.resize(working, size, interpolation=cv2.INTER_LINEAR)
        other = np.asarray(cv2.dilate(changed.astype(np.uint8), np.ones((3, 3), np.uint8)), np.uint8)
        return np.asarray(np.where(cv2.resize(other, size, interpolation=cv2.INTER_NEAREST) > 0, enlarged, full), np.uint8)
