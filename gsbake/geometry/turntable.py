"""The turntable that poses show: cameras on exact circles about the axis of a table, for each position of the object on it.

As the object sees it, a camera that stands moves about the axis of the table by a pure rotation. So all photos of a round have one height,
one distance and one orientation to the axis, to the accuracy of the poses, which neither a camera in the hand nor a spiral has.
A camera that is moved between rounds makes several circles; an object that is laid down differently has another axis.

The turn between two photos of a round is about the axis. The direction that most pairs agree on, and the line in that direction, are the
axis. Photos count whose height, distance and orientation enough others of other azimuths share; those with slightly others must be few,
else they lie along a spiral. What is left is searched for a further axis: the object was laid down differently. Its photos are fewer and
its poses less exact, but there is no question any more whether there is a table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gsbake.geometry.cameras import Camera

Doubles = NDArray[np.float64]

#: Largest difference of two photos of a round, in radians and in shares of the distance. Solved poses differ by .01, from hand by .05.
SAME_ROUND = 0.02
#: The same where an axis was found already: poses of the second position of a tankard differ by .03.
SAME_FURTHER = 0.03
#: Fewest photos of a round.
MIN_ROUND = 5
#: Within so many times SAME_ROUND a photo of a round has few others than those of its round: this share is of the round.
NEARBY, MIN_ALONE = 3.0, 0.5
#: Least turn in degrees between two photos for them to say where the axis is, and to count for one another.
MIN_TURN = 8.0
#: Least range of the azimuths about an axis, in degrees.
MIN_RANGE = 90.0
#: Directions of the axis that are tried, pairs of photos they are compared on, and pairs that must agree.
DIRECTIONS, PAIRS, MIN_PAIRS = 1000, 4000, 6


@dataclass(frozen=True)
class Turntable:
    """A table: its upward `axes` (positions, 3) in the object's frame and a point (positions, 3) on each, the `position` (n,) of the object
    in each photo, and whether the photo's camera stands on an exact circle (n,)."""

    axes: Doubles
    points: Doubles
    position: NDArray[np.int64]
    on_circle: NDArray[np.bool_]

    @property
    def share(self) -> float:
        """Share of the cameras that stand on exact circles."""
        return float(self.on_circle.mean())

    @property
    def counts(self) -> list[int]:
        """Photos of each position."""
        return np.bincount(self.position, minlength=len(self.axes)).tolist()

    def to_room(self, cameras: Sequence[Camera]) -> Doubles:
        """Rotations (n, 3, 3) from the object's frame to that of the room, where up is the z axis and the camera stands in the direction of
        the x axis, in whatever position the object lies."""
        rows = [_frames((c.centre - self.points[k])[None], self.axes[k])[0] for c, k in zip(cameras, self.position, strict=True)]
        return np.stack(rows)


def find_turntable(cameras: Sequence[Camera]) -> Turntable | None:
    """The turntable before the `cameras`, which are posed in the object's frame; None where there is none."""
    if len(cameras) < MIN_ROUND:
        return None
    rotation, centre = np.stack([c.R for c in cameras]), np.stack([c.centre for c in cameras])
    lines: list[tuple[Doubles, Doubles]] = []
    position = np.full(len(cameras), -1)
    while (left := np.flatnonzero(position < 0)).size >= MIN_ROUND and (line := _axis(rotation[left], centre[left])) is not None:
        inside = left[_in_rounds(rotation[left], centre[left], *line, further=bool(lines))]
        if len(inside) < MIN_ROUND:
            break
        upright = -np.sign(np.mean(rotation[inside, 1] @ line[0])) or 1.0  # y axes of cameras point down
        position[inside] = len(lines)
        lines.append((upright * line[0], line[1]))
    if not lines:
        return None
    # What no round has belongs to the position whose cameras stand, with respect to its axis, as this one does.
    apart = np.stack([_nearest(rotation, centre, *line, position == k) for k, line in enumerate(lines)])
    axes, points = map(np.stack, zip(*lines, strict=True))
    return Turntable(axes, points, np.where(position < 0, apart.argmin(0), position), position >= 0)


def _axis(rotation: Doubles, centre: Doubles) -> tuple[Doubles, Doubles] | None:
    """Direction (3,) and a point (3,) of the axis about which most pairs of cameras are turned into each other; None where few are."""
    first, second = np.triu_indices(len(rotation), 1)
    kept = np.unique(np.linspace(0, len(first) - 1, min(PAIRS, len(first))).round().astype(int))
    turn = np.swapaxes(rotation[second[kept]], 1, 2) @ rotation[first[kept]]
    vector = Rotation.from_matrix(turn).as_rotvec()
    angle = np.linalg.norm(vector, axis=1)
    far = np.degrees(angle) > MIN_TURN
    if far.sum() < MIN_PAIRS:
        return None
    turn, first, second, direction = turn[far], first[kept][far], second[kept][far], vector[far] / angle[far, None]
    step = (centre[second] - centre[first]) / max(float(np.median(np.linalg.norm(centre - centre.mean(0), axis=1))), 1e-300)

    def about(axis: Doubles) -> NDArray[np.bool_]:
        return (np.linalg.norm(turn @ axis - axis, axis=1) < SAME_ROUND) & (np.abs(step @ axis) < SAME_ROUND)

    tried = direction[np.linspace(0, len(direction) - 1, min(DIRECTIONS, len(direction))).round().astype(int)]
    axis = max(tried, key=lambda a: int(about(a).sum()))
    pairs = about(axis)
    if pairs.sum() < MIN_PAIRS:
        return None
    axis = (direction[pairs] * np.sign(direction[pairs] @ axis)[:, None]).mean(0)
    axis /= np.linalg.norm(axis)
    # A point p of the axis stays: (I - M) p = c2 - M c1, across the axis.
    across = np.eye(3) - np.outer(axis, axis)
    rows = (across @ (np.eye(3) - turn[pairs])).reshape(-1, 3)
    values = ((centre[second] - np.einsum("nij,nj->ni", turn, centre[first]))[pairs] @ across).ravel()
    weight = np.ones(len(values))
    point = np.zeros(3)
    for _ in range(5):  # robust: pairs of other tables may agree by chance
        point = np.linalg.lstsq(np.concatenate([rows * weight[:, None], axis[None]]), np.append(values * weight, 0), rcond=None)[0]
        error = np.linalg.norm((rows @ point - values).reshape(-1, 3), axis=1)
        weight = np.repeat(1 / np.sqrt(1 + (error / max(float(np.median(error)), 1e-12)) ** 2), 3)
    return axis, point


def _frames(offset: Doubles, axis: Doubles) -> Doubles:
    """Rows (n, 3, 3) of the frames at the azimuths of the `offset` (n, 3) from the axis: outward, along the circle, up."""
    outward = offset - (offset @ axis)[:, None] * axis
    outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-300)
    return np.stack([outward, np.cross(axis, outward), np.broadcast_to(axis, outward.shape)], 1)


def _seen_from_axis(rotation: Doubles, centre: Doubles, axis: Doubles, point: Doubles) -> tuple[Doubles, Doubles]:
    """What does not change in a round, (n, 11): height, distance from the axis and orientation; and the azimuth (n,) in degrees."""
    offset = centre - point
    height, frame = offset @ axis, _frames(offset, axis)
    distance = np.linalg.norm(offset - height[:, None] * axis, axis=1)
    scale = max(float(np.median(np.hypot(height, distance))), 1e-300)
    turned = (rotation @ np.swapaxes(frame, 1, 2)).reshape(-1, 9) / np.sqrt(2)
    azimuth = np.degrees(np.arctan2(frame[:, 0] @ frame[0, 1], frame[:, 0] @ frame[0, 0]))
    return np.concatenate([height[:, None] / scale, distance[:, None] / scale, turned], 1), azimuth


def _in_rounds(rotation: Doubles, centre: Doubles, axis: Doubles, point: Doubles, further: bool) -> NDArray[np.bool_]:
    """Which cameras (n,) are in rounds about the axis: none where they turn little, or where others are just beside, as on a spiral, which
    is not asked about a `further` axis."""
    constant, azimuth = _seen_from_axis(rotation, centre, axis, point)
    apart = np.linalg.norm(constant[:, None] - constant[None], axis=2)
    turned = np.abs((azimuth[:, None] - azimuth[None] + 180) % 360 - 180) > MIN_TURN
    bound = SAME_FURTHER if further else SAME_ROUND
    same, nearby = ((turned & (apart < b)).sum(1) for b in (bound, NEARBY * bound))
    core = same >= MIN_ROUND - 1
    if not core.any() or _range(azimuth[core]) < MIN_RANGE or not further and np.median(same[core] / nearby[core]) < MIN_ALONE:
        return np.zeros(len(rotation), bool)
    return np.asarray(core | (apart[:, core] < bound).any(1))


def _range(azimuth: Doubles) -> float:
    """The range of the azimuths in degrees, around their largest gap."""
    around = np.sort(azimuth)
    return 360 - max(float(np.diff(around, append=around[0] + 360).max()), 0.0)


def _nearest(rotation: Doubles, centre: Doubles, axis: Doubles, point: Doubles, members: NDArray[np.bool_]) -> Doubles:
    """How far the cameras (n,) are, as seen from the axis, from the next of the `members` (n,) of a position."""
    constant, _ = _seen_from_axis(rotation, centre, axis, point)
    return np.asarray(np.linalg.norm(constant[:, None] - constant[None, members], axis=2).min(1))
