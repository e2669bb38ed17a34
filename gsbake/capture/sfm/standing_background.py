"""Detection of a background that stands while the object turns: a turntable before a camera on a tripod.

Structure from motion explains most features at once. Where camera and room stand, those of the room say that the camera never moved, and
contradict those of the object. Such a room is the same, pixel by pixel, in all photos of one round, which no photos of a camera that moves
are: blocks of two photos are compared by normalised cross-correlation, which exposure does not change. What is the same in most photos of a
round is then left out of feature detection; what moves, the object and what turns with it, is left. The tripod may be moved between rounds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.imaging.correlation import Floats, Windows
from gsbake.imaging.png import read_grey, write_png

#: Longer side in pixels of the photos that are compared, and side of a block. Blocks of less contrast (grey levels) say nothing.
SIZE, BLOCK, MIN_CONTRAST = 192, 16, 5.0
#: Correlation from which a block is the same in two photos.
SAME_BLOCK = 0.95
#: Share of the blocks that are the same in two photos of one round; of more, nothing moved between them.
MIN_SAME_SHARE, MAX_SAME_SHARE = 0.15, 0.95
#: Fewest blocks with contrast that decide about two photos.
MIN_BLOCKS = 5
#: Other photos of its round that a photo needs, and share of the photos that have them where a background stands.
MIN_PARTNERS, MIN_STANDING_PHOTOS = 4, 0.5
#: Share of the photos that have another one of their round from which a background may stand.
MIN_SUSPECTED_PHOTOS = 0.1
#: Longer side in pixels of the masks of what moves, and window of the correlation there.
MASK_SIZE, WINDOW = 480, 9
#: Photos of its round that a photo is compared with there; the share of them in which a pixel that stands is the same.
COMPARED, MIN_SAME_PHOTOS = 12, 0.5
#: Correlation from which a pixel's window is the same. Plain windows, of less contrast, are the same up to this difference (grey levels).
SAME_WINDOW, PLAIN_CONTRAST, PLAIN_DIFFERENCE = 0.85, 4.0, 6.0


@dataclass(frozen=True)
class StandingBackground:
    """Photos `files` by name with a standing background, and the `partners` of each: other photos of its round."""

    files: Mapping[str, Path]
    partners: Mapping[str, Sequence[str]]

    @property
    def _count(self) -> int:
        """Photos with enough partners."""
        return sum(len(found) >= MIN_PARTNERS for found in self.partners.values())

    @property
    def evidence(self) -> str:
        """What was found, for the log."""
        return f"{self._count} of {len(self.files)} photos share their background, pixel by pixel, with {MIN_PARTNERS} others or more"

    @property
    def stands(self) -> bool:
        """Whether so many photos share their background that the object was turned before it."""
        return self._count >= MIN_STANDING_PHOTOS * max(len(self.files), 1)

    @property
    def suspected(self) -> bool:
        """Whether a background may stand, which no photos of a camera that moves make believe."""
        return sum(map(bool, self.partners.values())) >= MIN_SUSPECTED_PHOTOS * len(self.files)

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """All pairs of photos of one round."""
        return sorted({(min(name, other), max(name, other)) for name, others in self.partners.items() for other in others})

    def write_moving_parts(self, folder: Path) -> Path:
        """Write what moves in each photo as a mask of the photo's size, under the name that COLMAP expects; the folder.

        255 moves or may move: all of a photo with too few partners.
        """
        folder.mkdir(parents=True, exist_ok=True)
        small, sizes = {}, {}
        for name, path in self.files.items():
            photo = read_grey(path)
            small[name], sizes[name] = _shrunk(photo, MASK_SIZE), photo.shape[::-1]
        for name in self.files:
            others = [small[partner] for partner in _spread(self.partners[name])]
            moves = _moving(small[name], others) if len(self.partners[name]) >= MIN_PARTNERS else np.ones(small[name].shape, bool)
            mask = cv2.resize(255 * moves.astype(np.uint8), sizes[name], interpolation=cv2.INTER_NEAREST)
            write_png(folder / f"{name}.png.png", np.asarray(mask, np.uint8))
        return folder


def find_standing_background(files: Mapping[str, Path]) -> StandingBackground:
    """Compare all photos, files by name; those of other sizes are of other rounds."""
    names = list(files)
    shapes: dict[tuple[int, int], list[int]] = {}
    blocks = [_blocks(_shrunk(read_grey(path), SIZE)) for path in files.values()]
    for index, block in enumerate(blocks):
        shapes.setdefault(block.shape, []).append(index)
    partners: dict[str, list[str]] = {name: [] for name in names}
    for members in shapes.values():
        share = _same_share(np.stack([blocks[i] for i in members]))
        for row, index in enumerate(members):
            order = np.argsort(-share[row], kind="stable")
            good = (share[row] >= MIN_SAME_SHARE) & (share[row] <= MAX_SAME_SHARE)
            partners[names[index]] = [names[members[k]] for k in order if good[k] and k != row]
    return StandingBackground(files, partners)


def moved_between(first: Path, second: Path) -> bool:
    """Whether two photos differ in more than noise; those of other sizes do."""
    blocks = [_blocks(_shrunk(read_grey(path), SIZE)) for path in (first, second)]
    return blocks[0].shape != blocks[1].shape or bool(_same_share(np.stack(blocks))[0, 1] <= MAX_SAME_SHARE)


def _shrunk(grey: NDArray[np.uint8], size: int) -> Floats:
    """A photo's grey levels (h, w), resampled so that the longer side has `size` pixels."""
    scale = size / max(grey.shape)
    shape = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
    return np.asarray(cv2.resize(grey, shape, interpolation=cv2.INTER_AREA), np.float32)


def _blocks(grey: Floats) -> Floats:
    """Blocks (n, BLOCK²) of mean 0 and length 1; zeros where there is too little contrast."""
    rows, columns = grey.shape[0] // BLOCK, grey.shape[1] // BLOCK
    cut = grey[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK).transpose(0, 2, 1, 3).reshape(-1, BLOCK**2)
    cut = cut - cut.mean(1, keepdims=True)
    length = np.linalg.norm(cut, axis=1, keepdims=True)
    return np.asarray(np.where(length >= MIN_CONTRAST * BLOCK, cut / np.maximum(length, 1e-6), 0), np.float32)


def _same_share(blocks: Floats) -> NDArray[np.float64]:
    """Share (n, n) of the blocks with contrast in both photos that are the same; `blocks` are (n, blocks, BLOCK²)."""
    same = np.zeros((len(blocks), len(blocks)))
    both = np.zeros_like(same)
    for k in range(blocks.shape[1]):
        block = blocks[:, k]
        contrast = (block != 0).any(1)
        both += np.outer(contrast, contrast)
        same += block @ block.T > SAME_BLOCK
    return np.where(both >= MIN_BLOCKS, same / np.maximum(both, 1), 0.0)


def _spread(partners: Sequence[str]) -> list[str]:
    """At most COMPARED partners, evenly along the list: the most similar ones show the object turned by little."""
    chosen = np.linspace(0, len(partners) - 1, min(COMPARED, len(partners))).round().astype(int)
    return [partners[k] for k in chosen]


def _moving(grey: Floats, others: Sequence[Floats]) -> NDArray[np.bool_]:
    """Pixels (h, w) of a photo that differ from most of the `others` of its round."""
    photo, same = Windows.of(grey, WINDOW), np.zeros(grey.shape, np.float32)
    for other in (Windows.of(image, WINDOW) for image in others):
        plain = photo.contrast(other) < PLAIN_CONTRAST
        same += np.where(plain, np.abs(photo.mean - other.mean) < PLAIN_DIFFERENCE, photo.correlate(other, SAME_WINDOW))
    moves = (same < MIN_SAME_PHOTOS * len(others)).astype(np.uint8)
    moves = np.asarray(cv2.morphologyEx(moves, cv2.MORPH_OPEN, np.ones((WINDOW, WINDOW), np.uint8)), np.uint8)
    return np.asarray(moves > 0)
