"""Mean, deviation and range of each channel, in one pass over arrays that need not be in memory together.

Statistics are values: `ChannelStats.of` takes one array, `merged` joins two, `over` does both along a stream. Which
episodes go in is the caller's choice, and it must be the training ones alone.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from vilp_data.errors import StoreError, VilpDataError
from vilp_data.types import F64

STATS_FORMAT = 1


@dataclass(frozen=True)
class ChannelStats:
    """Statistics of C channels over `count` values each.

    mean, min, max  float64 [C]
    sum_sq          float64 [C]: sum of squared deviations from the mean
    """

    count: int
    mean: F64
    sum_sq: F64
    min: F64
    max: F64

    @property
    def std(self) -> F64:
        """float64 [C], of the population (divided by `count`); exactly 0 for a channel that never changes."""
        return np.sqrt(self.sum_sq / self.count)

    @classmethod
    def of(cls, values: npt.NDArray[Any], *, channel_axis: int = -1) -> ChannelStats:
        """Statistics of one array, with `channel_axis` kept and all others gone over; computed in float64.

        Raises VilpDataError where `values` is empty or holds NaN or infinity."""
        rows = np.moveaxis(values, channel_axis, 0).reshape(values.shape[channel_axis], -1).astype(np.float64)
        if rows.shape[1] == 0:
            raise VilpDataError("no values to take statistics of", found=f"shape {values.shape}")
        low, high = rows.min(axis=1), rows.max(axis=1)
        broken = ~np.isfinite(low) | ~np.isfinite(high)  # min and max carry NaN on
        if broken.any():
            raise VilpDataError(
                "values that are not finite",
                found=f"NaN or infinity in channel {', '.join(map(str, np.flatnonzero(broken)))}",
                remedy="leave invalid steps out; where valid ones hold such values, ingest or encode that episode again",
            )
        mean = np.clip(rows.mean(axis=1), low, high)  # the rounded mean of equal values may miss them by an ulp
        return cls(rows.shape[1], mean, np.square(rows - mean[:, None]).sum(axis=1), low, high)

    def merged(self, other: ChannelStats) -> ChannelStats:
        """Statistics of both sets of values together (Chan, Golub and LeVeque 1979, eq. 2.1)."""
        count = self.count + other.count
        delta = other.mean - self.mean
        return ChannelStats(
            count,
            self.mean + delta * (other.count / count),
            self.sum_sq + other.sum_sq + np.square(delta) * (self.count * other.count / count),
            np.minimum(self.min, other.min),
            np.maximum(self.max, other.max),
        )

    @classmethod
    def over(cls, arrays: Iterable[npt.NDArray[Any]], *, channel_axis: int = -1) -> ChannelStats:
        """Statistics over a stream of arrays, one in memory at a time; empty ones are passed over.

        Raises VilpDataError where there is nothing, or something that is not finite."""
        total: ChannelStats | None = None
        for array in arrays:
            if array.size:
                stats = cls.of(array, channel_axis=channel_axis)
                total = stats if total is None else total.merged(stats)
        if total is None:
            raise VilpDataError(
                "no values to take statistics of", remedy="the training side needs an episode with valid steps"
            )
        return total

    def to_json(self, **labels: str) -> bytes:
        """A statistics file: the same bytes for the same values. `labels` say what they belong to (split hash, key)."""
        table: dict[str, Any] = {
            "format": STATS_FORMAT,
            "labels": labels,
            "count": self.count,
            "std": self.std.tolist(),
        }
        table |= {name: getattr(self, name).tolist() for name in ("mean", "sum_sq", "min", "max")}
        return (json.dumps(table, indent=1, sort_keys=True) + "\n").encode()

    @classmethod
    def from_json(cls, data: bytes, *, where: object = "stats.json") -> tuple[ChannelStats, dict[str, str]]:
        """The statistics and the labels they were written with. Raises StoreError where `data` is something else."""
        try:
            table = json.loads(data)
            if table["format"] != STATS_FORMAT:
                raise ValueError(f"format {table['format']!r}, this is {STATS_FORMAT}")
            columns = {name: np.array(table[name], np.float64) for name in ("mean", "sum_sq", "min", "max")}
            return cls(count=int(table["count"]), **columns), dict(table["labels"])
        except (KeyError, TypeError, ValueError) as error:
            remedy = "delete it and run the command that makes it again"
            raise StoreError("not a statistics file", where=where, found=repr(error), remedy=remedy) from error
