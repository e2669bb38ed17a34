"""First guess of a photo's mask: the probability per pixel that it shows the salient object, by the small U²-Net.

Qin et al., *U²-Net: going deeper with nested U-structure for salient object detection* (Pattern Recognition 2020). OpenCV runs the ONNX
file, so that no further runtime is needed. The network sees the whole photo at 320 × 320 pixels, so that a guess is accurate to a few
pixels at best, and one photo at a time, so that it may take something else for the object: `gsbake.capture.masks.consensus` repairs that.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsbake.capture.masks.weights import WEIGHTS
from gsbake.capture.photos.decode import Bytes

#: Edge of the network's input in pixels, and mean and standard deviation of its training photos (RGB, 0 … 1).
INPUT_SIZE = 320
_MEAN, _DEVIATION = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)
#: Longer side of a guess in pixels: more than the network resolves.
GUESS_SIZE = 512


class SaliencyNetwork:
    """The network, ready to run on `threads` threads."""

    def __init__(self, threads: int, weights: Path = WEIGHTS) -> None:
        cv2.setNumThreads(threads)
        self._net: Any = cv2.dnn.readNetFromONNX(str(weights))
        # The first output fuses those of all scales.
        self._output = self._net.getUnconnectedOutLayersNames()[0]

    def probability(self, rgb: Bytes) -> Bytes:
        """Probability of the salient object (h, w), 255 = 1, of an 8-bit photo (height, width, 3); the longer side is GUESS_SIZE at most.

        As in training, the photo is divided by its brightest value, and the output is stretched to 0 … 1.
        """
        photo = cv2.resize(rgb, (INPUT_SIZE, INPUT_SIZE), interpolation=cv2.INTER_AREA).astype(np.float32)
        photo = (photo / max(float(photo.max()), 1.0) - _MEAN) / _DEVIATION
        self._net.setInput(np.ascontiguousarray(photo.transpose(2, 0, 1)[None], np.float32))
        out = np.asarray(self._net.forward(self._output), np.float32)[0, 0]
        low, high = float(out.min()), float(out.max())
        out = (out - low) / max(high - low, 1e-6)
        height, width = rgb.shape[:2]
        scale = min(1.0, GUESS_SIZE / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        return np.asarray(np.rint(255 * cv2.resize(out, size, interpolation=cv2.INTER_CUBIC).clip(0, 1)), np.uint8)
