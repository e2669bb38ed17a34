"""Selection of the photo pairs whose features are matched.

Small captures are matched exhaustively. Larger ones rank pairs by matches among the largest-scale features of each photo ("preemptive
matching": Wu, *Towards linear-time incremental structure from motion*, 3DV 2013), at a hundredth of the cost. Very large ones rank pairs
by VLAD descriptors (Jégou et al., CVPR 2010) over a vocabulary trained on the capture itself, so that no vocabulary file is needed. Photos
that are adjacent by name are always matched.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Pair = tuple[int, int]

#: Exhaustive matching up to this many photos, preemptive ranking up to the second number, VLAD beyond.
MAX_EXHAUSTIVE_PHOTOS = 40
MAX_RANKED_PHOTOS = 500
#: Best-ranked partners per photo, and neighbours by name on either side that are always matched.
PARTNERS = 16
NAME_NEIGHBOURS = 3
#: Neighbours by name of video frames in sequential matching, which adds those 2, 4, 8… photos away up to this power.
SEQUENTIAL_OVERLAP = 10
#: Largest ratio of the distances to the best and the second-best match (Lowe, IJCV 2004).
_MAX_RATIO = 0.85


def is_sequence(names: Sequence[str]) -> bool:
    """Whether names end in numbers that mostly increase by a constant step, as video frames and camera series do."""
    numbers = [int(m.group(1)) for name in names if (m := re.search(r"(\d+)\D*$", name))]
    if len(numbers) < max(3, 0.9 * len(names)):
        return False
    steps = np.diff(numbers)
    return bool((steps > 0).mean() > 0.9 and (steps == np.median(steps)).mean() > 0.5)


def exhaustive(count: int) -> list[Pair]:
    """All pairs i < j."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def sequential(count: int, overlap: int = SEQUENTIAL_OVERLAP) -> list[Pair]:
    """Pairs of photos up to `overlap` apart in order, and 2^k apart up to 2^overlap."""
    gaps = sorted({*range(1, overlap + 1), *(2**k for k in range(overlap + 1))})
    return [(i, i + gap) for gap in gaps for i in range(max(count - gap, 0))]


def _unit(descriptors: NDArray[np.uint8]) -> Floats:
    flat = descriptors.astype(np.float32)
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6)


def largest_features(descriptors: NDArray[np.uint8], scales: Floats, count: int) -> Floats:
    """Unit descriptors (≤ count, 128) of the largest features."""
    keep = np.argsort(-scales, kind="stable")[:count]
    return _unit(descriptors[keep])


def preemptive_scores(features: Sequence[Floats], tick: Callable[[int, int], None] | None = None) -> NDArray[np.float64]:
    """Symmetric (n, n) counts of mutual nearest neighbours between the features of two photos that pass the ratio test."""
    n = len(features)
    scores = np.zeros((n, n))
    limit = np.float32(_MAX_RATIO**2)
    for i in range(n):
        for j in range(i + 1, n):
            if min(len(features[i]), len(features[j])) < 2:
                continue
            similar = features[i] @ features[j].T
            best = similar.argmax(1)
            rows = np.arange(len(best))
            top = similar[rows, best]
            mutual = similar.argmax(0)[best] == rows
            similar[rows, best] = -1.0
            second = similar.max(1)
            # Squared distances of unit vectors are 2 - 2 cos.
            scores[i, j] = scores[j, i] = int((mutual & (1 - top < limit * (1 - second))).sum())
        if tick:
            tick(i + 1, n)
    return scores


def vlad_scores(features: Sequence[Floats], seed: int, words: int = 64) -> NDArray[np.float64]:
    """Symmetric (n, n) cosines of VLAD vectors over a vocabulary of `words` trained on the same features."""
    from scipy.cluster.vq import kmeans2

    rng = np.random.default_rng(seed)
    full = np.concatenate([f for f in features if len(f)] or [np.zeros((1, 128), np.float32)])
    sample = full[rng.choice(len(full), min(len(full), 20_000), replace=False)]
    words = min(words, len(sample))
    centres, _ = kmeans2(sample, words, iter=10, minit="points", rng=rng)
    vectors = np.zeros((len(features), words, full.shape[1]), np.float32)
    for vector, descriptors in zip(vectors, features, strict=True):
        if len(descriptors):
            word = (descriptors @ centres.T - 0.5 * (centres**2).sum(1)).argmax(1)
            np.add.at(vector, word, descriptors - centres[word])
    vectors /= np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), 1e-6)  # intra-normalised: no word dominates
    flat = vectors.reshape(len(features), -1)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6)
    return np.asarray(flat @ flat.T, float)


def best_pairs(scores: NDArray[np.float64], partners: int, neighbours: int) -> list[Pair]:
    """Each photo's best `partners` by score, its `neighbours` in order on either side, and a maximum spanning tree, so that the graph is
    connected."""
    from scipy.sparse.csgraph import minimum_spanning_tree

    n = len(scores)
    pairs: set[Pair] = set()
    ranked = np.argsort(-(scores - np.diag(np.full(n, np.inf))), axis=1, kind="stable")
    for i in range(n):
        chosen = [int(j) for j in ranked[i, :partners] if j != i and scores[i, j] > 0]
        chosen += [j for gap in range(1, neighbours + 1) for j in (i - gap, i + gap) if 0 <= j < n]
        pairs.update((min(i, j), max(i, j)) for j in chosen)
    cost = np.triu(scores.max() + 1.0 - scores, 1)
    rows, columns = minimum_spanning_tree(cost).nonzero()
    pairs.update((int(min(i, j)), int(max(i, j))) for i, j in zip(rows, columns, strict=True))
    return sorted(pairs)


def choose_matching(setting: str, names: Sequence[str]) -> tuple[str, str]:
    """The kind of matching ("exhaustive", "ranked", "sequential" or "vocabulary") and the evidence."""
    count = len(names)
    if setting != "auto":
        return setting, "set by the profile"
    if count <= MAX_EXHAUSTIVE_PHOTOS:
        return "exhaustive", f"{count} photos, at most {MAX_EXHAUSTIVE_PHOTOS}: all pairs"
    if count <= MAX_RANKED_PHOTOS:
        return "ranked", f"{count} photos: best {PARTNERS} partners of each by matches of the largest features"
    if is_sequence(names):
        return "sequential", f"{count} photos with consecutive names, loops by VLAD"
    return "vocabulary", f"{count} photos: best partners of each by VLAD"


def neighbouring_views(
    centres: NDArray[np.float64], directions: NDArray[np.float64], partners: int = PARTNERS, max_angle: float = 75.0
) -> list[Pair]:
    """Pairs of cameras with known poses: each one's `partners` nearest by angle and position, at most `max_angle` degrees apart.

    centres (n, 3), directions (n, 3) unit view directions.
    """
    cosine = directions @ directions.T
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    cost = (1 - cosine) + distance / max(float(distance.max()), 1e-12)
    cost[cosine < np.cos(np.radians(max_angle))] = np.inf
    np.fill_diagonal(cost, np.inf)
    pairs: set[Pair] = set()
    for i, row in enumerate(cost):
        pairs.update((min(i, int(j)), max(i, int(j))) for j in np.argsort(row)[:partners] if np.isfinite(row[j]))
    return sorted(pairs)
