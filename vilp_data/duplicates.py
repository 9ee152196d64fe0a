"""Near-identical episodes, found by thumbnails: what a content hash cannot see, such as a log exported twice."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from vilp_data.types import F32, U8

# Grey levels of 255, root mean square: another codec changes the means of 8x8 cells by less, another run by more.
NEAR_DISTANCE = 1.0
THUMBNAIL_SIZE = 8


@dataclass(frozen=True)
class NearDuplicate:
    """Two episodes whose thumbnails differ by `distance` grey levels (root mean square, of 255)."""

    first: str
    second: str
    distance: float


def thumbnails(frames: U8) -> F32:
    """Grey thumbnails, float32 [3,8,8] in 0..255, of the first, middle and last of `frames` uint8 [n,H,W,3], n >= 1."""
    grey = frames[[0, len(frames) // 2, len(frames) - 1]].mean(axis=3, dtype=np.float64)
    return _cell_means(_cell_means(grey, axis=1), axis=2).astype(np.float32)


def near_duplicates(thumbnails: Mapping[str, npt.NDArray[Any]]) -> list[NearDuplicate]:
    """Pairs of episodes within NEAR_DISTANCE, closest first. Thumbnails of different shapes are not compared.

    Compares all pairs: O(n^2) time, 0.1 s for a thousand episodes of two views; O(n) memory."""
    by_shape: dict[tuple[int, ...], list[str]] = defaultdict(list)
    for id in sorted(thumbnails):
        by_shape[thumbnails[id].shape].append(id)
    pairs = []
    for ids in by_shape.values():
        pixels = np.stack([np.asarray(thumbnails[id], np.float32).ravel() for id in ids])
        for row, first in enumerate(ids[:-1]):
            distance = np.sqrt(np.mean((pixels[row + 1 :] - pixels[row]) ** 2, axis=1, dtype=np.float64))
            for offset in np.flatnonzero(distance <= NEAR_DISTANCE):
                pairs.append(NearDuplicate(first, ids[row + 1 + offset], round(float(distance[offset]), 3)))
    return sorted(pairs, key=lambda pair: (pair.distance, pair.first, pair.second))


def _cell_means(images: npt.NDArray[np.float64], axis: int) -> npt.NDArray[np.float64]:
    """Means over THUMBNAIL_SIZE nearly equal ranges of one axis; an axis shorter than that repeats pixels."""
    edges = np.arange(THUMBNAIL_SIZE + 1) * images.shape[axis] // THUMBNAIL_SIZE
    return np.stack([images.take(range(a, max(b, a + 1)), axis).mean(axis) for a, b in pairwise(edges)], axis)
