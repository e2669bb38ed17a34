"""Matches of SIFT descriptors against a plain PyTorch twin."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gsbake.capture.sfm.matching import MAX_DISTANCE, MAX_RATIO, match_descriptors, match_pairs

Bytes = NDArray[np.uint8]


def descriptors(rng: np.random.Generator, count: int) -> Bytes:
    """Sparse random descriptors of about the length of SIFT's, 512."""
    values = rng.gamma(1.0, 1.0, (count, 128))
    return np.asarray(np.clip(np.round(512 * values / np.linalg.norm(values, axis=1, keepdims=True)), 0, 255), np.uint8)


def photographed_again(rng: np.random.Generator, of: Bytes, noise: float) -> Bytes:
    return np.asarray(np.clip(of + rng.normal(0, noise, of.shape), 0, 255), np.uint8)


def plain_matches(a: Bytes, b: Bytes) -> list[list[int]]:
    """The same tests in float64 on the whole matrix of products."""
    products = torch.from_numpy(a).double() @ torch.from_numpy(b).double().T
    found = []
    for i in range(len(a)):
        j = int(products[i].argmax())
        if int(products[:, j].argmax()) != i:
            continue
        for others in (products[i], products[:, j]):
            best = torch.topk(others, min(2, len(others))).values.tolist()
            distance = [max(0.0, 2 - 2 * value / 512**2) ** 0.5 for value in (*best, -1.0)[:2]]
            if distance[0] > MAX_DISTANCE or distance[0] >= MAX_RATIO * distance[1]:
                break
        else:
            found.append([i, j])
    return found


@pytest.mark.parametrize(("count", "other"), [(1, 1), (1, 40), (63, 65), (300, 700), (1000, 64)])
def test_matches_equal_those_of_the_twin(count: int, other: int) -> None:
    rng = np.random.default_rng(count)
    a = descriptors(rng, count)
    both = photographed_again(rng, a[: min(count, other) // 2 + 1], 3.0)
    b = rng.permutation(np.concatenate([both, descriptors(rng, other - len(both))]))
    found = match_descriptors(a, b)
    assert found.dtype == np.uint32 and len(found) >= len(both) // 2
    assert found.tolist() == plain_matches(a, b)


def test_ambiguous_and_far_descriptors_are_not_matched() -> None:
    rng = np.random.default_rng(0)
    a = descriptors(rng, 50)
    assert match_descriptors(a, a).tolist() == [[i, i] for i in range(50)]
    assert not len(match_descriptors(a, np.concatenate([a, a])))
    assert not len(match_descriptors(np.eye(2, 128, dtype=np.uint8) * 255, np.eye(2, 128, 64, dtype=np.uint8) * 255))


@pytest.mark.parametrize("shapes", [(0, 5), (5, 0), (0, 0)])
def test_photos_without_features_have_no_matches(shapes: tuple[int, int]) -> None:
    a, b = (np.full((count, 128), 40, np.uint8) for count in shapes)
    assert match_descriptors(a, b).shape == (0, 2)


def test_pairs_come_in_order_from_any_number_of_threads() -> None:
    rng = np.random.default_rng(1)
    photos = [descriptors(rng, 200)]
    photos += [photographed_again(rng, photos[0], 4.0) for _ in range(5)]
    pairs = [(i, j) for i in range(6) for j in range(i)]
    results: list[Any] = [list(match_pairs(pairs, photos.__getitem__, threads)) for threads in (1, 2, 7)]
    for result in results:
        assert [pair for pair, _ in result] == pairs
        assert all(np.array_equal(found, match_descriptors(photos[i], photos[j])) for (i, j), found in result)
    assert all(len(found) > 100 for _, found in results[0])
