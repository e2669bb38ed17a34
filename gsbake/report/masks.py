"""Images of the automatic masks that a person should look at."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsbake.report.html import Panel, image_uri

#: Most masks shown, the most doubtful first, and their longer side in pixels.
MAX_SHOWN, PANEL_SIZE = 12, 320
#: Brightness of the background beside that of the object, and the colour of the outline (BGR).
_DIMMED, _OUTLINE = 0.35, (60, 220, 255)


def mask_panels(poses: Path, results: Mapping[str, Any]) -> tuple[Panel, ...]:
    """Panels of the doubtful masks of the poses stage: its folder and the results in its manifest."""
    panels = []
    for name in list(results.get("doubtful_masks") or ())[:MAX_SHOWN]:
        photo: Any = cv2.imread(str(poses / "photos" / f"{name}.png"), cv2.IMREAD_COLOR)
        mask: Any = cv2.imread(str(poses / "masks" / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        if photo is None or mask is None:  # left out as redundant
            continue
        panels.append(Panel(name, "automatic mask", image_uri(_outlined(photo, mask)[..., ::-1])))
    return tuple(panels)


def _outlined(photo: Any, mask: Any) -> Any:
    """The photo (h, w, 3) in 0 … 1 and BGR, reduced, its background dimmed and the mask outlined."""
    scale = min(1.0, PANEL_SIZE / max(photo.shape[:2]))
    size = max(1, round(photo.shape[1] * scale)), max(1, round(photo.shape[0] * scale))
    photo, inside = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (photo, mask))
    binary = (inside > 127).astype(np.uint8)
    out = np.where(binary[..., None] > 0, photo, _DIMMED * photo).astype(np.uint8)
    contours, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(out, list(contours), -1, _OUTLINE, 1, cv2.LINE_AA)
    return out / np.float32(255)
