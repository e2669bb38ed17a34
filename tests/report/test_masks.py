"""Doubtful automatic masks in the report."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from gsbake.report.masks import MAX_SHOWN, mask_panels


def test_doubtful_masks_are_shown_where_they_are(tmp_path: Path) -> None:
    for sub in ("photos", "masks"):
        (tmp_path / sub).mkdir()
    names = [f"p{i:02}" for i in range(MAX_SHOWN + 3)]
    for name in names[1:]:
        cv2.imwrite(str(tmp_path / "photos" / f"{name}.png"), np.full((60, 90, 3), 200, np.uint8))
        mask = np.zeros((60, 90), np.uint8)
        mask[20:40, 30:60] = 255
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), mask)
    panels = mask_panels(tmp_path, {"doubtful_masks": names})
    assert [panel.title for panel in panels] == names[1:MAX_SHOWN], "photos that were left out have no files"
    assert all(panel.image.startswith("data:image/jpeg") for panel in panels)
    assert mask_panels(tmp_path, {}) == ()
