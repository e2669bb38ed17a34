"""Frames of a video as photos: evenly along the camera's motion, the sharpest of each stretch.

The video is decoded twice. The first pass measures each frame at a small size: its sharpness (variance of the Laplacian) and the motion
since the frame before (median length of dense optical flow; Farnebäck, *Two-frame motion estimation based on polynomial expansion*, SCIA
2003).
The cumulative motion is divided into equal stretches, so that a camera at rest does not give many equal photos, and the second pass writes
the sharpest frame of each. Videos come from strangers: this runs in a process of its own (`video_process`), and FFmpeg may use the readers
of containers alone, and files alone: its lists of other files (ffconcat, HLS, SDP, numbered images) would open what they name.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.photos.decode import UnreadablePhotoError
from gsbake.capture.photos.hdr import TRANSFERS, frame_to_srgb
from gsbake.capture.photos.video_transfer import video_transfer
from gsbake.imaging.png import write_png

#: FFmpeg's readers of the containers in which videos come, by FFmpeg's names; all others are refused, whatever a file is called.
CONTAINERS = ("mov", "mp4", "m4a", "3gp", "3g2", "mj2", "matroska", "webm", "avi")
#: OpenCV's variable for options of FFmpeg.
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
#: Longer side in pixels at which sharpness and motion are measured.
ANALYSIS_SIZE = 240
#: Share of the motion that is added evenly in time: a film without motion still gives frames.
EVEN_SHARE = 0.1


@dataclass(frozen=True)
class FrameMeasures:
    """`sharpness` (n,) and `motion` (n,) since the frame before, as a share of the longer side, of all frames."""

    sharpness: NDArray[np.float64]
    motion: NDArray[np.float64]


def frames(path: Path, max_megapixels: float) -> Iterator[NDArray[np.uint8]]:
    """All frames (h, w, 3) BGR in order, upright. Raises UnreadablePhotoError where there is no frame, or too large ones."""
    os.environ[_OPTIONS] = f"format_whitelist;{','.join(CONTAINERS)}|protocol_whitelist;file"
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        width, height = video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if not video.isOpened() or width < 1 or height < 1:
            raise UnreadablePhotoError("it is damaged, no MP4, MOV, AVI, MKV or WebM, or its codec is not known")
        if width * height / 1e6 > max_megapixels:
            raise UnreadablePhotoError(f"its frames have {width * height / 1e6:.0f} megapixels, more than ingest.max_megapixels")
        count = 0
        while True:
            read, frame = video.read()
            if not read:
                break
            count += 1
            yield np.asarray(frame, np.uint8)
        if not count:
            raise UnreadablePhotoError("no frame of it can be decoded")
    finally:
        video.release()


def measure(path: Path, max_megapixels: float) -> FrameMeasures:
    """Sharpness and motion of all frames."""
    sharpness, motion = [], []
    before: NDArray[np.uint8] | None = None
    for frame in frames(path, max_megapixels):
        scale = min(1.0, ANALYSIS_SIZE / max(frame.shape[:2]))
        size = max(8, round(frame.shape[1] * scale)), max(8, round(frame.shape[0] * scale))
        grey = np.asarray(cv2.cvtColor(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY), np.uint8)
        sharpness.append(float(cv2.Laplacian(grey, cv2.CV_32F).var()))
        motion.append(0.0 if before is None else _flow(before, grey))
        before = grey
    return FrameMeasures(np.array(sharpness), np.array(motion))


def _flow(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """Median length of the optical flow between two grey frames, as a share of the longer side."""
    flow = cv2.calcOpticalFlowFarneback(before, after, np.zeros((*before.shape, 2), np.float32), 0.5, 3, 15, 2, 5, 1.1, 0)
    return float(np.median(np.linalg.norm(flow, axis=2)) / max(before.shape))


def choose(measures: FrameMeasures, count: int) -> NDArray[np.int64]:
    """Indices of at most `count` frames in order: all, or the sharpest of each of `count` equal stretches of the motion."""
    total = len(measures.motion)
    if total <= count:
        return np.arange(total)
    moved = np.cumsum(measures.motion)
    even = np.arange(total) / max(1, total - 1)
    along = even if moved[-1] <= 0 else (1 - EVEN_SHARE) * moved / moved[-1] + EVEN_SHARE * even
    stretch = np.minimum((along * count).astype(np.int64), count - 1)
    order = np.lexsort((-measures.sharpness, stretch))
    first = np.unique(stretch[order], return_index=True)[1]
    return np.sort(order[first])


def write_frames(path: Path, out: Path, count: int, max_megapixels: float) -> tuple[int, int, str]:
    """Write the chosen frames of a video into the folder `out` as frame_NNNNNN.png, in sRGB; the number written, that of all frames, and
    the name of the HDR transfer that was undone, or "".

    Raises UnreadablePhotoError, and OSError where a frame cannot be written.
    """
    measures = measure(path, max_megapixels)
    chosen = set(choose(measures, count).tolist())
    transfer = video_transfer(path) or 0
    written = 0
    for index, frame in enumerate(frames(path, max_megapixels)):
        if index in chosen:
            rgb = np.ascontiguousarray(frame[..., ::-1])
            write_png(out / f"frame_{index:06d}.png", frame_to_srgb(rgb, transfer) if transfer in TRANSFERS else rgb)
            written += 1
    return written, len(measures.motion), TRANSFERS.get(transfer, "")
