"""Statistics as LeRobot keeps them: of each feature its minimum, maximum, mean, deviation, count and quantiles. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from vilp_data.types import I64, U8

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

Stats = dict[str, Any]
"""Name of a statistic -> nested lists of numbers: [D] of a vector, [C,1,1] of images, [1] of the count."""


def vector_stats(values: npt.NDArray[Any]) -> Stats:
    """Of rows [n,D] or [n], NaN left out: float64 [D]. Empty where no row is finite."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return {}
    stats = {"min": rows.min(axis=0), "max": rows.max(axis=0), "mean": rows.mean(axis=0), "std": rows.std(axis=0)}
    stats |= {name: np.quantile(rows, share, axis=0) for name, share in QUANTILES.items()}
    return {name: value.tolist() for name, value in stats.items()} | {"count": [len(rows)]}


def pixel_counts(images: Iterable[U8]) -> I64:
    """How often each value occurs in each channel, int64 [C,256], of uint8 [H,W,C] images."""
    counts: I64 | None = None
    for image in images:
        channels = [np.bincount(image[..., c].reshape(-1), minlength=256) for c in range(image.shape[-1])]
        counts = np.stack(channels) if counts is None else counts + np.stack(channels)
    return counts if counts is not None else np.zeros((0, 256), np.int64)


def image_stats(counts: I64, n_images: int) -> Stats:
    """Of pixels scaled to 0 … 1, exactly, from `pixel_counts`: float64 [C,1,1]."""
    values, total = np.arange(256) / 255.0, counts.sum(axis=1, keepdims=True)
    mean = (counts * values).sum(axis=1, keepdims=True) / total
    variance = (counts * (values - mean) ** 2).sum(axis=1, keepdims=True) / total
    share = np.cumsum(counts, axis=1) / total
    stats = {"mean": mean[:, 0], "std": np.sqrt(variance[:, 0])}
    stats["min"] = values[np.argmax(counts > 0, axis=1)]
    stats["max"] = values[255 - np.argmax(counts[:, ::-1] > 0, axis=1)]
    stats |= {name: values[np.argmax(share >= q, axis=1)] for name, q in QUANTILES.items()}
    return {name: value.reshape(-1, 1, 1).tolist() for name, value in stats.items()} | {"count": [n_images]}


def flat(stats: Mapping[str, Stats]) -> dict[str, Any]:
    """`stats/<feature>/<statistic>` -> value, as the table of episodes has them."""
    return {f"stats/{feature}/{name}": value for feature, table in stats.items() for name, value in table.items()}
