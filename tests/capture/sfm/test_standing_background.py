"""A room that stands while the object turns is found, and left out of feature detection and matching; other captures are not touched."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.capture.sfm.standing_background import MIN_PARTNERS, StandingBackground, find_standing_background

HEIGHT, WIDTH, COUNT = 180, 240, 8
Bytes = NDArray[np.uint8]


def texture(seed: int, height: int, width: int) -> Bytes:
    """Random grey levels with detail of some pixels."""
    coarse = np.random.default_rng(seed).integers(0, 255, (height // 5, width // 5)).astype(np.uint8)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


def write(folder: Path, photo: Callable[[int], Bytes]) -> dict[str, Path]:
    folder.mkdir()
    files = {f"p{i}": folder / f"p{i}.png" for i in range(COUNT)}
    for i, path in enumerate(files.values()):
        cv2.imwrite(str(path), photo(i))
    return files


def turned(i: int, seed: int = 0, gain: float = 1.0) -> Bytes:
    """An object, a rectangle in the middle whose texture differs from photo to photo, before room `seed`, with sensor noise."""
    image = texture(seed, HEIGHT, WIDTH).astype(float)
    image[50:130, 80:160] = texture(100 + i, 80, 80)
    noise = np.random.default_rng(1000 + i).normal(0, 1.5, image.shape)
    return np.clip(gain * image + noise, 0, 255).astype(np.uint8)


def overlap(mask: Bytes) -> float:
    true = np.zeros((HEIGHT, WIDTH), bool)
    true[50:130, 80:160] = True
    return float((true & (mask > 0)).sum() / (true | (mask > 0)).sum())


def test_a_standing_room_is_left_out(tmp_path: Path) -> None:
    found = find_standing_background(write(tmp_path / "photos", turned))
    assert found.stands and all(len(others) == COUNT - 1 for others in found.partners.values())
    assert len(found.pairs) == COUNT * (COUNT - 1) // 2
    found.write_moving_parts(tmp_path / "moving")
    for name in found.files:
        mask = cv2.imread(str(tmp_path / "moving" / f"{name}.png.png"), cv2.IMREAD_GRAYSCALE)
        assert mask is not None and mask.shape == (HEIGHT, WIDTH)
        assert overlap(np.asarray(mask, np.uint8)) > 0.85


def test_exposures_may_differ(tmp_path: Path) -> None:
    found = find_standing_background(write(tmp_path / "photos", lambda i: turned(i, gain=0.5 + 0.06 * i)))
    assert found.stands


def test_rounds_are_separate(tmp_path: Path) -> None:
    """The tripod was moved once, with too few photos after it: these keep all their features."""
    found = find_standing_background(write(tmp_path / "photos", lambda i: turned(i, seed=int(i >= 5))))
    assert found.stands and set(found.partners["p0"]) == {"p1", "p2", "p3", "p4"} and set(found.partners["p7"]) == {"p5", "p6"}
    found.write_moving_parts(tmp_path / "moving")
    small = cv2.imread(str(tmp_path / "moving" / "p7.png.png"), cv2.IMREAD_GRAYSCALE)
    assert small is not None and (small == 255).all()


@pytest.mark.parametrize("name", ["a camera that moves", "a photo taken several times", "a plain backdrop"])
def test_other_captures_have_none(name: str, tmp_path: Path) -> None:
    wide = texture(7, HEIGHT, WIDTH + 20 * COUNT)

    def photo(i: int) -> Bytes:
        if name == "a camera that moves":
            return np.ascontiguousarray(wide[:, 20 * i : 20 * i + WIDTH])
        if name == "a photo taken several times":
            return np.clip(wide[:, :WIDTH] + np.random.default_rng(i).normal(0, 1.5, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8)
        image = np.full((HEIGHT, WIDTH), 200, np.uint8)
        image[50:130, 80:160] = texture(100 + i, 80, 80)
        return image

    assert not find_standing_background(write(tmp_path / "photos", photo)).stands


def test_photos_of_other_sizes_are_of_other_rounds(tmp_path: Path) -> None:
    files = write(tmp_path / "photos", lambda i: turned(i)[: HEIGHT - 30 * (i % 2)])
    found = find_standing_background(files)
    assert set(found.partners["p0"]) == {"p2", "p4", "p6"} and not found.stands


def test_most_photos_decide() -> None:
    names = [f"p{i}" for i in range(COUNT)]
    partners = {name: names[:MIN_PARTNERS] if i < COUNT // 2 else [] for i, name in enumerate(names)}
    files = {name: Path(name) for name in names}
    assert StandingBackground(files, partners).stands
    assert not StandingBackground(files, partners | {names[0]: []}).stands
