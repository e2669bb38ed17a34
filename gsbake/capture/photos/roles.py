"""Roles of photos: most are fitted, every n-th is held out, half of those for decisions (validation) and half for figures (test)."""

from __future__ import annotations


def held_out(count: int, every: int) -> list[int]:
    """Indices of the held-out photos: every n-th in the order of the camera set, none for 0 or tiny sets."""
    if every <= 0 or count < 2 * every:
        return []
    return list(range(every // 2, count, every))


def validation_photos(count: int, every: int) -> list[int]:
    """The held-out photos that decisions look at: every second one, from the first."""
    return held_out(count, every)[::2]


def test_photos(count: int, every: int) -> list[int]:
    """The held-out photos that no decision looks at: figures that are reported use these alone."""
    return held_out(count, every)[1::2]
