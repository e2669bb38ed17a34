"""Which features are tried first, cameras that coincide, and when mapping ends."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gsbake.capture.sfm.coincidence import coinciding
from gsbake.capture.sfm.feature_masks import FeatureMasks
from gsbake.capture.sfm.mapping_gain import MappingGain
from gsbake.capture.sfm.reconstruction import written_models
from gsbake.capture.sfm.trial import PHOTOS, Trial, best_region, write_small_photos
from tests.support.cameras import look_at


def test_the_region_that_the_masks_support_wins() -> None:
    whole, masks = Trial("whole photos", 24, 24, 0.55, 0.4), Trial("masks", 20, 24, 0.93, 0.6)
    outside = Trial("outside the masks", 22, 24, 0.91, 0.9)
    assert best_region([whole, masks], 0.8) == "masks"
    assert best_region([whole, masks, outside], 0.8) == "outside the masks"  # more photos
    assert best_region([Trial("whole photos", 20, 24, 0.9, 0.7), masks], 0.8) == "masks"  # as many, less error
    few = Trial("masks", 8, 24, 0.95, 0.3)
    assert best_region([whole, few, Trial("outside the masks", 24, 24, 0.1, 0.3)], 0.8) == "masks"  # the others are contradicted
    assert best_region([Trial("whole photos", 9, 24, 0.2, 0.5), few], 0.8) == "whole photos"  # too few photos to say so
    assert best_region([whole, Trial("masks", 20, 24, 0.5, 0.6)], 0.8) == "whole photos"
    assert best_region([], 0.8) == "whole photos"


def test_small_photos_keep_the_field_of_view(tmp_path: Path) -> None:
    image = np.zeros((900, 1200, 3), np.uint8)
    entries = []
    for k in range(PHOTOS + 2):
        cv2.imwrite(str(tmp_path / f"p{k:02}.png"), image)
        mask = f"m{k}.png" if k % 2 else None
        size = {"width": 1200, "height": 900, "focal_px": 1000.0, "camera_model": None}
        entries.append({"name": f"p{k:02}", "file": f"p{k:02}.png", "mask": mask, "guess": "g.png", **size})
    small = write_small_photos(tmp_path, entries[::-1], tmp_path / "small")
    assert [e["name"] for e in small] == [f"p{k:02}" for k in range(PHOTOS)]
    assert {(e["width"], e["height"], e["focal_px"], e["mask"]) for e in small} == {(600, 450, 500.0, None)}
    assert [e["guess"] for e in small[:2]] == ["g.png", "m1.png"]
    assert cv2.imread(str(tmp_path / "small" / "p00.png")).shape == (450, 600, 3)


def test_features_outside_the_masks(tmp_path: Path) -> None:
    """What a dilated guess does not show, at the size of the photo."""
    guess = np.zeros((60, 80), np.uint8)
    guess[20:40, 30:50] = 255
    cv2.imwrite(str(tmp_path / "g.png"), guess)
    entry = {"name": "a", "mask": None, "guess": "g.png", "width": 160, "height": 120}
    inside = cv2.imread(str(FeatureMasks(tmp_path, [entry], tmp_path / "in").write() / "a.png.png"), cv2.IMREAD_GRAYSCALE)
    outside = cv2.imread(str(FeatureMasks(tmp_path, [entry], tmp_path / "out").write(outside=True) / "a.png.png"), cv2.IMREAD_GRAYSCALE)
    assert inside.shape == (120, 160) and (outside == 255 - inside).all() and 0.08 < (inside > 0).mean() < 0.15


def test_cameras_of_different_photos_coincide(tmp_path: Path) -> None:
    """Two photos of a standing camera before which something turned, two equal ones, and others of other cameras."""
    rng = np.random.default_rng(0)
    room = rng.integers(0, 255, (240, 320), np.uint8)
    turned = room.copy()
    turned[80:200, 100:220] = rng.integers(0, 255, (120, 120), np.uint8)
    photos = {"a": room, "b": turned, "c": room, "d": room, "e": turned}
    for name, image in photos.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), cv2.resize(image, (640, 480), interpolation=cv2.INTER_NEAREST))
    files = {name: tmp_path / f"{name}.png" for name in photos}
    first, second = np.array([3.0, 0, 0]), np.array([0.0, 3, 0])
    cameras = [
        look_at(first, size=64, focal=80, name="a"),
        look_at(first + [0, 0.005, 0], size=64, focal=80, name="b"),
        look_at(second, size=64, focal=80, name="c"),
        look_at(second, size=64, focal=80, name="d"),
        look_at(np.array([0.0, 1, 3]), size=64, focal=80, name="e"),
    ]
    points = rng.normal(0, 0.3, (100, 3))
    assert coinciding(cameras, points, files) == ["a", "b"]
    assert coinciding(cameras, points[:0], files) == [] and coinciding(cameras[:1], points, files) == []


@pytest.mark.parametrize(
    ("models", "ends"),
    [
        ([30], False),
        ([30, 12, 9], False),
        ([30, 12, 9, 4], True),  # three smaller ones after it
        ([3, 12, 9, 4], False),
        ([3, 30, 5, 5, 5], True),
    ],
)
def test_mapping_ends_after_models_that_gain_nothing(models: list[int], ends: bool) -> None:
    gain = MappingGain(66)
    for size in models:
        assert not gain.model_begins()
        assert not any(gain.photo_registered() for _ in range(size - 2))
    assert gain.model_begins() is ends


def test_mapping_ends_where_photos_are_registered_again_and_again() -> None:
    gain = MappingGain(10)
    assert [gain.photo_registered() for _ in range(20)] == [False] * 18 + [True] * 2


def test_models_of_a_mapping_that_was_ended(tmp_path: Path) -> None:
    """COLMAP numbers the folders of new models, and writes a continued one into the folder itself."""
    assert written_models(tmp_path) == []
    new, continued = tmp_path / "strict", tmp_path / "relaxed"
    for folder in (new / "0", new / "2", new / "10", continued):
        folder.mkdir(parents=True)
        (folder / "images.bin").touch()
    (new / "3").mkdir()  # ended before it was written
    assert written_models(new) == [new / "0", new / "2", new / "10"]
    assert written_models(continued) == [continued]
