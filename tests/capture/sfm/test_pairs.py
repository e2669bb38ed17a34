from __future__ import annotations

import numpy as np

from gsbake.capture.sfm.pairs import (
    best_pairs,
    choose_matching,
    exhaustive,
    is_sequence,
    largest_features,
    neighbouring_views,
    preemptive_scores,
    sequential,
    vlad_scores,
)


def ring_of_photos(count: int, per_photo: int = 60) -> list[np.ndarray]:  # type: ignore[type-arg]
    """Descriptors of photos on a closed ring: each shares half of its features with the next."""
    rng = np.random.default_rng(0)
    words = rng.random((count, per_photo // 2, 128)).astype(np.float32) ** 4
    photos = []
    for i in range(count):
        mine = np.concatenate([words[i], words[(i + 1) % count]]) + rng.normal(0, 0.01, (per_photo, 128)).astype(np.float32)
        photos.append(mine / np.linalg.norm(mine, axis=1, keepdims=True))
    return photos


def test_ranking_finds_the_neighbours_on_the_ring() -> None:
    photos = ring_of_photos(12)
    for scores in (preemptive_scores(photos), vlad_scores(photos, 0, words=24)):
        assert np.allclose(scores, scores.T)
        found = set(best_pairs(scores, 2, 0))
        ring = {(min(i, (i + 1) % 12), max(i, (i + 1) % 12)) for i in range(12)}
        assert ring <= found
    assert preemptive_scores(photos)[0, 1] == 30  # exactly the shared half
    assert preemptive_scores(photos)[0, 6] <= 2


def test_best_pairs_connect_all_groups() -> None:
    scores = np.zeros((6, 6))
    for group in ((0, 1, 2), (3, 4, 5)):
        for i in group:
            for j in group:
                scores[i, j] = 50 if i != j else 0
    scores[1, 4] = scores[4, 1] = 1
    assert (1, 4) in best_pairs(scores, 2, 0)
    assert {(2, 3), (1, 2)} <= set(best_pairs(scores, 0, 1))


def test_strongest_features_are_the_largest() -> None:
    descriptors = np.eye(4, 128, dtype=np.uint8) * 200
    few = largest_features(descriptors, np.array([1.0, 9.0, 4.0, 2.0], np.float32), 2)
    assert few.shape == (2, 128) and few[0, 1] == 1 and few[1, 2] == 1


def test_sequences() -> None:
    assert is_sequence([f"frame_{i:04d}" for i in range(0, 300, 3)])
    assert is_sequence([f"IMG_{i}" for i in (9669, 9670, 9671, 9673, 9674, 9675)])
    assert not is_sequence(["front", "left", "back"])
    assert not is_sequence([f"P81019-{i}" for i in (151014, 151250, 151016, 151300, 151018, 151222)])
    assert set(sequential(4, 2)) == {(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)}
    assert (0, 16) in sequential(20, 4) and (0, 5) not in sequential(20, 4)
    assert len(exhaustive(69)) == 69 * 68 // 2


def test_choice_by_count_and_names() -> None:
    assert choose_matching("auto", [f"{i}" for i in range(40)])[0] == "exhaustive"
    assert choose_matching("auto", [f"{i}" for i in range(300)])[0] == "ranked"
    assert choose_matching("auto", [f"frame{i:05d}" for i in range(800)])[0] == "sequential"
    assert choose_matching("auto", [f"{i * i}x" for i in range(800)])[0] == "vocabulary"
    assert choose_matching("sequential", ["a"])[0] == "sequential"


def test_neighbouring_views_have_similar_directions() -> None:
    angle = np.arange(24) * 2 * np.pi / 24
    eyes = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    pairs = neighbouring_views(eyes, -eyes, partners=4)
    gaps = [min(j - i, 24 - (j - i)) for i, j in pairs]
    assert max(gaps) <= 2 and (0, 1) in pairs and (0, 23) in pairs and len(pairs) == 48
